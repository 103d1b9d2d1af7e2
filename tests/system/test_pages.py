"""The pages for readers: short enough, complete, and every file that they name is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from splatnode.capture.config import PreviewHeader
from splatnode.capture.frame import ExposureSettings, GivenPose, Gravity, Intrinsics, Motion
from splatnode.capture.messaging import messages, network, pubsub
from splatnode.capture.status import CaptureStatus
from splatnode.recon.daemon import ReconState, ReconStatus
from splatnode.recon.daemon.node import Finish, RemoveKeyframe
from splatnode.recon.locating import LocateAnswer, LocateRequest, LocationRecord
from splatnode.recon.occupancy import MapHeader, MapRecord, ProvisionalRecord
from splatnode.recon.result.export import list_format_names
from splatnode.recon.result.message import BoundsRecord, CameraRecord, ReferenceFrameRecord, ScaleRecord, SceneHeader
from splatnode.recon.result.verdict import Code
from tests.conftest import ROOT

DOCS = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*.md"))
PAGES = ["README.md", "CONVENTIONS.md", "CONTRIBUTING.md", "CHANGELOG.md", *DOCS]
LINES = {"README.md": 130, "CHANGELOG.md": 80}


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", LINES)
def test_a_page_is_short_enough(page):
    assert len(text(page).splitlines()) <= LINES[page]


@pytest.mark.parametrize("page", [*DOCS, "README.md", "CHANGELOG.md", "CONVENTIONS.md", "CONTRIBUTING.md"])
def test_no_page_is_of_two_versions(page):
    marks = ("<" * 7, ">" * 7)  # of a merge that was not finished
    assert not [line for line in text(page).splitlines() if line.startswith(marks)]


def test_every_page_of_the_site_is_in_its_navigation():
    listed = re.findall(r"\w+\.md", str(yaml.safe_load(text("mkdocs.yml"))["nav"]))
    assert sorted(f"docs/{name}" for name in listed) == DOCS, "nav of mkdocs.yml must list every page of docs/, once"


@pytest.mark.parametrize("page", PAGES)
def test_a_link_leads_to_a_file(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", text(page)):
        path = link.partition("#")[0]
        if path and "://" not in link:
            assert (ROOT / page).parent.joinpath(path).exists(), f"{page} links to {link}, which is not there"


@pytest.mark.parametrize("page", PAGES)
def test_paths_that_a_page_names_are_there(page):
    for path in re.findall(r"`((?:capture|recon|viewer|extras|tests|configs|docs|splatnode)/[\w./*-]*)`", text(page)):
        if not {"NAME", "NAME.py", "FOLDER"} & set(path.split("/")):  # a file that somebody is to write
            assert list(ROOT.glob(path.rstrip("/"))), f"{page} names {path}, which is not there"


@pytest.mark.parametrize("code", [code.value for code in Code])
def test_every_verdict_is_explained(code):
    page = text("docs/verdicts.md")
    assert f"| [`{code}`](#{code.lower()}) |" in page, f"the table of docs/verdicts.md lacks {code}"
    _, _, rest = page.partition(f"\n### {code}\n")
    told = re.split(r"^##", rest, maxsplit=1, flags=re.MULTILINE)[0]
    assert told.strip(), f"docs/verdicts.md does not explain {code}"
    assert code == "OK" or re.search(r"\bremedy\b", told, re.IGNORECASE), f"docs/verdicts.md has no remedy for {code}"


def test_no_verdict_is_explained_that_there_is_not():
    explained = re.findall(r"^### ([A-Z_]+)$", text("docs/verdicts.md"), re.MULTILINE)
    assert sorted(explained) == sorted(code.value for code in Code)


SECTIONS = {
    "SceneHeader": SceneHeader,
    "ScaleRecord": ScaleRecord,
    "ReferenceFrameRecord": ReferenceFrameRecord,
    "MapHeader": MapHeader,
    "MapRecord": MapRecord,
    "ProvisionalRecord": ProvisionalRecord,
    "LocateRequest": LocateRequest,
    "LocateAnswer": LocateAnswer,
    "LocationRecord": LocationRecord,
    "CameraRecord": CameraRecord,
    "BoundsRecord": BoundsRecord,
    "Want": pubsub.Want,
    "PreviewHeader": PreviewHeader,
    "CaptureStatus": CaptureStatus,
    "ReconStatus": ReconStatus,
    "Fields that all headers have": messages.Header,
}
ROWS = (
    Finish,
    RemoveKeyframe,
    pubsub.MarkProblemsSeen,
    pubsub.Answer,
    messages.Ready,
    messages.ConsumerStatus,
    messages.Delivery,
    messages.FrameHeader,
    messages.DroppedHeader,
    messages.Acknowledge,
    messages.Refuse,
)


def own_fields(record: type) -> set[str]:
    """Without those that all headers have, which the page tells once."""
    fields, common = set(record.__struct_fields__), set(messages.Header.__struct_fields__)
    return fields - common if common < fields else fields


@pytest.mark.parametrize("title", SECTIONS)
def test_every_field_of_a_message_is_told(title):
    _, _, rest = text("docs/messages.md").partition(f"# {title}\n")
    section = re.split(r"^#", rest, maxsplit=1, flags=re.MULTILINE)[0]
    first_cells = " ".join(row.split(" | ")[0] for row in section.splitlines() if row.startswith("| `"))
    assert set(re.findall(r"`(\w+)`", first_cells)) - {"type"} == own_fields(SECTIONS[title])


@pytest.mark.parametrize("record", ROWS, ids=lambda record: record.__name__)
def test_every_small_record_is_told(record):
    (row,) = re.findall(rf"^\| {record.__name__} \|.*$", text("docs/messages.md"), re.MULTILINE)
    named = set(re.findall(r"`(\w+)`", row))
    assert {record.__struct_config__.tag, *own_fields(record)} <= named


def test_every_service_state_and_field_of_a_lens_is_told():
    page = text("docs/messages.md")
    offered = [each for each in vars(network).values() if isinstance(each, network.Service)]
    both = [*offered, *(each.requests for each in offered if each.pattern is network.Pattern.STATE)]
    rows = re.findall(r"^\| `([\w.]+)` \| \w+ \| (\w+) \| \+(\d+) \|", page, re.MULTILINE)
    assert {(each.name, each.pattern.name.lower(), str(each.tcp_port)) for each in both} == set(rows)
    records = (Intrinsics, GivenPose, Motion, Gravity, ExposureSettings)
    of_records = [name for record in records for name in record.__dataclass_fields__]
    named = [f"`{each.value}`" for each in ReconState] + [f"`{name}`" for name in of_records]
    assert not [name for name in named if name not in page]
    assert f"`SPLAT`, then one byte with the version ({messages.VERSION})" in page and all(
        f"`{dtype}`" in page for dtype in messages.DTYPES
    )


def test_every_export_format_is_told():
    table = text("docs/files.md").partition("## Export\n")[2].partition("\n## ")[0]
    assert sorted(re.findall(r"^\| `(\w+)` \| `", table, re.MULTILINE)) == list_format_names()


def test_every_camera_is_told():
    kinds = {path.stem for path in Path(ROOT, "capture", "cameras").glob("[a-z]*.py")}
    assert not [kind for kind in kinds if f"\n| `{kind}` | " not in text("docs/cameras.md")]
