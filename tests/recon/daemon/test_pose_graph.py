"""Where scenes lie by their links: exactly where these agree, between them where they do not, without a wrong loop."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from splatnode.recon.daemon.pose_graph import LEAST_DEG, LEAST_RELATIVE, EdgeKind, PoseGraphEdge, optimize_pose_graph
from splatnode.recon.daemon.submap_index import SubmapIndex, SubmapState, make_submap_record
from splatnode.recon.geometry import Similarity
from tests.support.exported import make_snapshot

NUM = 12  # scenes on a circle
SCENES = [f"scene-{index:04d}" for index in range(1, NUM + 1)]


def worlds(seed: int = 0) -> list[Similarity]:
    """Each scene's world in the common one: somewhere on a circle, turned and scaled at random."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, NUM, endpoint=False)
    return [
        Similarity(
            float(rng.uniform(0.5, 2.0)),
            Rotation.from_rotvec(rng.normal(size=3)).as_matrix(),
            10 * np.array([np.cos(angle), np.sin(angle), 0.0]),
        )
        for angle in angles
    ]


def link(
    at: list[Similarity], i: int, j: int, kind: EdgeKind = EdgeKind.CHAIN, wrong: Similarity | None = None
) -> PoseGraphEdge:
    """As the worlds lie; `wrong` is applied to scene j, in the world of i."""
    found = at[i].inverse().after(at[j])
    found = found if wrong is None else wrong.after(found)
    return PoseGraphEdge(
        kind=kind,
        scene=SCENES[i],
        other=SCENES[j],
        scale=found.scale,
        rotation=tuple(map(tuple, found.rotation.tolist())),
        translation=tuple(found.translation.tolist()),
        shared=(),
        rotation_deg=0.0,
        centre_percent=0.0,
        centre=tuple((found.translation / 2).tolist()),
        sigma_deg=LEAST_DEG,
        sigma_scale=LEAST_RELATIVE,
        sigma_position=LEAST_RELATIVE,
    )


def slightly(rng: np.random.Generator, growth: float = 0.0) -> Similarity:
    """An error of one standard deviation in each way, and `growth` of the scale."""
    return Similarity(
        float(np.exp(growth + rng.normal(scale=LEAST_RELATIVE))),
        Rotation.from_rotvec(rng.normal(scale=np.radians(LEAST_DEG), size=3)).as_matrix(),
        rng.normal(scale=LEAST_RELATIVE, size=3),
    )


def errors(at: list[Similarity], links: list[PoseGraphEdge]) -> np.ndarray:
    """(NUM,) by how far the scenes' origins are from where they are, in the world of the first scene."""
    poses = {pose.scene: pose for pose in optimize_pose_graph(SCENES, links).poses}
    assert {pose.map for pose in poses.values()} == {SCENES[0]}
    to_first = at[0].inverse()
    found = np.stack([poses[scene].translation for scene in SCENES])
    return np.linalg.norm(found - np.stack([to_first.after(each).translation for each in at]), axis=1)


def chain(at: list[Similarity], rng: np.random.Generator | None = None, growth: float = 0.0) -> list[PoseGraphEdge]:
    pairs = itertools.pairwise(range(NUM))
    return [link(at, i, j, wrong=None if rng is None else slightly(rng, growth)) for i, j in pairs]


def test_scenes_lie_where_exact_links_put_them():
    at = worlds()
    assert errors(at, [*chain(at), link(at, 0, NUM - 1, EdgeKind.LOOP)]).max() < 1e-6


def test_it_does_not_matter_from_which_of_its_scenes_a_link_is_told():
    at = worlds()
    backwards = [link(at, j, i) for i, j in itertools.pairwise(range(NUM))]
    assert errors(at, backwards).max() < 1e-6
    mixed = [each if index % 2 else other for index, (each, other) in enumerate(zip(chain(at), backwards, strict=True))]
    assert errors(at, mixed).max() < 1e-6


def test_a_loop_takes_the_drift_of_scale_out_of_a_chain():
    at, rng = worlds(), np.random.default_rng(1)
    drifting = chain(at, rng, growth=0.01)
    closed = [*drifting, link(at, 0, NUM - 1, EdgeKind.LOOP)]
    assert errors(at, closed).max() < 0.35 * errors(at, drifting).max()
    assert all(each.retracted is None for each in optimize_pose_graph(SCENES, closed).links)


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_loop_is_retracted_and_moves_nothing(seed):
    at, rng = worlds(seed), np.random.default_rng(seed)
    right = [*chain(at, rng), link(at, 0, NUM - 1, EdgeKind.LOOP), link(at, 3, 9, EdgeKind.LOOP)]
    elsewhere = Similarity(1.0, np.eye(3), rng.normal(scale=5.0, size=3))
    graph = optimize_pose_graph(SCENES, [*right, link(at, 2, 7, EdgeKind.LOOP, wrong=elsewhere)])
    assert [each.retracted is not None for each in graph.links] == [False] * len(right) + [True]
    assert "standard deviations" in (graph.links[-1].retracted or "")
    assert graph.poses == optimize_pose_graph(SCENES, right).poses


def test_a_retracted_loop_counts_again_where_others_agree_with_it():
    at = worlds()
    loop = msgspec.structs.replace(link(at, 0, NUM - 1, EdgeKind.LOOP), retracted="for the test")
    assert optimize_pose_graph(SCENES, [*chain(at), loop]).links[-1].retracted is None


def test_scenes_that_no_link_joins_are_maps_of_their_own():
    at = worlds()
    poses = optimize_pose_graph(SCENES[:5], [link(at, 1, 0), link(at, 3, 2, EdgeKind.LOOP)]).poses
    assert [pose.map for pose in poses] == [SCENES[0], SCENES[0], SCENES[2], SCENES[2], SCENES[4]]
    assert poses[4].scale == 1.0 and poses[4].translation == (0.0, 0.0, 0.0)


def test_a_link_to_a_scene_that_is_a_draft_again_is_forgotten_and_stops_nothing(tmp_path):
    index, at = SubmapIndex(tmp_path, "one"), worlds()
    final = [
        replace(
            make_submap_record(scene, SubmapState.FINISHED, None, make_snapshot(), [], []),
            publishable=True,
            provisional=False,
        )
        for scene in SCENES[:3]
    ]
    for place in final:
        index.update(place)
    index.add_loops(SCENES[1], [link(at, 0, 1, EdgeKind.LOOP)])
    assert [pose.map for pose in index.poses] == [SCENES[0], SCENES[0], SCENES[2]]
    index.update(replace(final[1], provisional=True, verified=False))
    index.add_loops(SCENES[2], [link(at, 0, 2, EdgeKind.LOOP)])
    assert [(each.scene, each.other) for each in index.links] == [(SCENES[0], SCENES[2])]
    assert [(pose.scene, pose.map) for pose in index.poses] == [(SCENES[0], SCENES[0]), (SCENES[2], SCENES[0])]
