"""What a walk through the building became: maps, cameras and loops against what is known of it.

A map is what scenes are joined to: by `poses` of places.json, or, where it has none, by its links. All lengths of a map
are those of its first scene; a map is compared with the truth after one similarity for all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatnode.recon.geometry import Similarity, align_cameras, angles_deg

WRONG_DEG, WRONG_PERCENT = 3.0, 5.0  # a link beyond either is wrong; percent of the scene's extent
FEWEST_SHOWING = 3  # keyframes of each of two scenes that must show what the other does, to make them a revisit

Cameras = Mapping[int, np.ndarray]  # T_world_camera (4, 4) by the number of the keyframe
Truth = Callable[[int], np.ndarray]  # the true T_world_camera of a keyframe
SamePlace = Callable[[int, int], bool]


@dataclass(frozen=True, eq=False)
class Maps:
    """By scene: the map that it is in, and the similarity from its own frame into the map's."""

    of: Mapping[str, tuple[str, Similarity]]


def similarity(row: Mapping) -> Similarity:
    return Similarity(float(row["scale"]), np.array(row["rotation"], float), np.array(row["translation"], float))


def maps(index: Mapping, scenes: Sequence[str]) -> Maps:
    """Of places.json. Scenes that nothing joins are maps of their own."""
    if "poses" in index:
        joined = {row["scene"]: (row["map"], similarity(row)) for row in index["poses"]}
        return Maps({scene: joined.get(scene, (scene, _same())) for scene in scenes})
    found: dict[str, tuple[str, Similarity]] = {}
    links = [link for link in index["links"] if not link.get("retracted")]
    for scene in scenes:
        if scene in found:
            continue
        found[scene] = scene, _same()
        for _ in links:
            for link in links:
                _join(found, link)
    return Maps({scene: found[scene] for scene in scenes})


def _join(found: dict[str, tuple[str, Similarity]], link: Mapping) -> None:
    scene, other = link["scene"], link["other"]
    if scene in found and other not in found:
        found[other] = found[scene][0], found[scene][1].after(similarity(link))
    elif other in found and scene not in found:
        found[scene] = found[other][0], found[other][1].after(similarity(link).inverse())


def _same() -> Similarity:
    return Similarity(1.0, np.eye(3), np.zeros(3))


def camera_rows(found: Mapping[str, Cameras], joined: Maps, truth: Truth) -> list[dict]:
    """A row for each map, the largest first: errors of its cameras after the map was laid on the truth."""
    names = {map_ for map_, _ in joined.of.values()}
    rows = [
        _camera_row([scene for scene in found if joined.of[scene][0] == name], found, joined, truth) for name in names
    ]
    return sorted((row for row in rows if row is not None), key=lambda row: -row["keyframes"])


def _camera_row(scenes: Sequence[str], found: Mapping[str, Cameras], joined: Maps, truth: Truth) -> dict | None:
    placed: dict[int, np.ndarray] = {}
    for scene in scenes:
        for keyframe, camera in found[scene].items():
            placed.setdefault(keyframe, joined.of[scene][1].camera(camera))
    if len(placed) < 3:
        return None
    order = sorted(placed)
    estimated, true = np.stack([placed[each] for each in order]), np.stack([truth(each) for each in order])
    laid = align_cameras(estimated, true)
    apart = np.linalg.norm(laid(estimated[:, :3, 3]) - true[:, :3, 3], axis=1)
    turned = angles_deg(laid.rotation @ estimated[:, :3, :3], true[:, :3, :3])
    path_m = path_length(truth, order[0], order[-1])
    return {
        "scenes": len(scenes), "keyframes": len(order), "path_m": path_m,
        "position_m_median": float(np.median(apart)), "position_m_most": float(apart.max()),
        "position_percent_of_path": 100 * float(np.sqrt((apart**2).mean())) / path_m,
        "rotation_deg_median": float(np.median(turned)), "rotation_deg_most": float(turned.max()),
    }  # fmt: skip


def path_length(truth: Truth, first: int, last: int) -> float:
    """Metres from keyframe to keyframe."""
    centres = np.stack([truth(each)[:3, 3] for each in range(first, last + 1)])
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def loop_row(
    found: Mapping[str, Cameras], joined: Maps, links: Sequence[Mapping], truth: Truth, same_place: SamePlace
) -> dict:
    """How many revisits there are, how many of them are linked or in one map, and which links are wrong."""
    standing = [link for link in links if not link.get("retracted") and {link["scene"], link["other"]} <= set(found)]
    chained = {frozenset((link["scene"], link["other"])) for link in standing if link.get("kind", "chain") == "chain"}
    looped = {frozenset((link["scene"], link["other"])) for link in standing if link.get("kind", "chain") == "loop"}
    order = sorted(found, key=lambda scene: min(found[scene]))
    revisits = [
        frozenset((first, second))
        for number, first in enumerate(order)
        for second in order[number + 2 :]
        if frozenset((first, second)) not in chained and is_revisit(found[first], found[second], same_place)
    ]
    errors = [{"scene": link["scene"], "other": link["other"], "kind": link.get("kind", "chain"),
               **link_error(found, link, truth)} for link in standing]  # fmt: skip
    one_map = [pair for pair in revisits if len({joined.of[scene][0] for scene in pair}) == 1]
    return {
        "revisits": len(revisits),
        "linked": sum(pair in looped for pair in revisits),
        "linked_or_in_one_map": sum(pair in looped or pair in one_map for pair in revisits),
        "loop_links": len(looped),
        "loop_links_that_are_no_revisit": len(looped - set(revisits)),
        "wrong_loop_links": sum(row["wrong"] for row in errors if row["kind"] == "loop"),
        "wrong_chain_links": sum(row["wrong"] for row in errors if row["kind"] == "chain"),
        "retracted": sum(bool(link.get("retracted")) for link in links),
        "missed": sorted(sorted(pair) for pair in revisits if pair not in looped and pair not in one_map),
        "links": errors,
    }


def is_revisit(first: Cameras, second: Cameras, same_place: SamePlace) -> bool:
    """Whether some keyframes of each scene show what keyframes of the other show. Shared ones do not count."""
    mine, theirs = [each for each in first if each not in second], [each for each in second if each not in first]
    pairs = [(a, b) for a in mine for b in theirs if same_place(a, b)]
    return min(len({a for a, _ in pairs}), len({b for _, b in pairs})) >= FEWEST_SHOWING


def link_error(found: Mapping[str, Cameras], link: Mapping, truth: Truth) -> dict:
    """By how much a link lays `other` wrongly into `scene`: degrees, and percent of the extent of the two."""
    into_scene = {each: _laid_on(found[each], truth) for each in (link["scene"], link["other"])}
    true = into_scene[link["scene"]].inverse().after(into_scene[link["other"]])
    told = similarity(link)
    turned = float(angles_deg(told.rotation[None], true.rotation[None]).max())
    centres = {each: np.stack([camera[:3, 3] for camera in found[each].values()]) for each in into_scene}
    theirs = true(centres[link["other"]])
    extent = max(float(np.ptp(part, axis=0).max()) for part in (centres[link["scene"]], theirs))
    apart = np.linalg.norm(told(centres[link["other"]]) - theirs, axis=1)
    percent = 100 * float(np.sqrt((apart**2).mean())) / extent
    return {"rotation_deg": turned, "percent": percent, "wrong": turned > WRONG_DEG or percent > WRONG_PERCENT}


def _laid_on(cameras: Cameras, truth: Truth) -> Similarity:
    """From a scene's frame to the true world."""
    return align_cameras(np.stack(list(cameras.values())), np.stack([truth(each) for each in cameras]))
