"""What each scene was used for is said, and follows from the raw files."""

from __future__ import annotations

import re

import pytest

from tests.reference.measured import raw, roles

MADE_UP = re.compile(r"demo|built-in|made up|scene-[\d-]+")  # no scene of a folder


def name_of(scene: str) -> str:
    """The scene without what says which of its images: `fox_first12`, `fountain6`, `kitchen@12`."""
    plain = re.sub(r"(_first|_last|@)?\d+$", "", scene)
    known = roles.read_roles()
    return scene if scene in known else next((name for name in known if plain in (name, *name.split("_"))), scene)


def raw_files() -> list[str]:
    return sorted(path.name.partition(".")[0] for path in raw.RESULTS.glob("*.json*") if path.name[:6] != "unseen")


@pytest.mark.parametrize("name", raw_files())
def test_each_scene_of_a_raw_file_has_a_role_and_none_is_unseen(name):
    known = roles.read_roles()
    found = {name_of(scene) for scene in roles.find_scenes(raw.raw(name)) if not MADE_UP.fullmatch(scene)}
    assert found <= set(known), "say in tests/bench/roles.json what these scenes were used for"
    assert not [scene for scene in found if "unseen" in known[scene].values()], "what has results has been looked at"


@pytest.mark.parametrize("name", roles.FITS)
def test_what_the_verdict_is_fitted_to_is_tuned_on(name):
    scenes = {name_of(scene) for scene in roles.find_scenes(raw.raw(name))}
    assert scenes and {roles.read_roles()[scene]["cameras"] for scene in scenes} == {"tuned on"}


def test_the_sets_of_the_presets_are_tuned_on():
    scenes = {name_of(scene) for scene in roles.find_scenes(raw.raw(roles.TUNED_SETS))}
    assert len(scenes) == 7 and {roles.read_roles()[scene]["scenes"] for scene in scenes} == {"tuned on"}


def test_roles_are_of_the_known_kinds():
    for role in roles.read_roles().values():
        assert set(role) == {"cameras", "scenes", "first_look"}
        assert {role["cameras"], role["scenes"]} <= set(roles.USES)
        assert (role["first_look"] is None) == (role["scenes"] == "unseen")


def test_scenes_are_found_wherever_a_raw_file_has_them():
    assert roles.find_scenes({"rows": [{"scene": "a", "parts": [{"scene": "b"}]}], "scene": 3}) == {"a", "b"}
