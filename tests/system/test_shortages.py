"""Whoever holds a failed read or write for the fault of a file asks first whether this process lacks something.

Each handler of OSError, or of everything, in the three rooms raises, or asks `process/system.py`, or is listed here
with what makes a shortage harmless to it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

ROOMS = ("capture", "recon", "viewer", "extras")
ASKS = {"is_shortage", "may_be_shortage", "raise_shortage", "outlast"}
WIDE = {"OSError", "Exception", "BaseException", "FFmpegError", "ZMQError"}
HARMLESS = {
    "it is tried again by itself, and nothing is lost until then": {
        "capture/cameras/watched.py:_version",
        "capture/daemon.py:_shortage",
        "capture/messaging/keyframe_queue.py:_say",
        "capture/messaging/keyframe_queue.py:_remove_acknowledged",
        "capture/messaging/pubsub.py:_reply",
        "capture/messaging/pubsub.py:reply",
        "capture/process/system.py:_notify",
        "capture/process/terminal.py:do",
        "recon/daemon/checkpoint.py:_prepare_keyframes",
        "recon/daemon/ledger.py:ensure_identity",
        "recon/daemon/checkpoint.py:_remove",
        "recon/daemon/node.py:_publish",
        "recon/daemon/ingest.py:_forget",
        "recon/daemon/ingest.py:run",
        "recon/daemon/free_space.py:run",
        "recon/daemon/relocalization.py:run",
        "recon/daemon/relocalization.py:_watch",
        "recon/result/export/staged.py:finish_interrupted_write",
        "viewer/sources.py:_listen",
    },
    "a shortage is told to whoever asked, as what it is": {
        "capture/daemon.py:_open_link",
        "capture/daemon.py:capture",
        "capture/process/system.py:resident_mb",
        "capture/process/system.py:make_sure_of_room",
        "capture/reader.py:_run",
        "extras/batch/command.py:write_back",
        "recon/daemon/node.py:_retract",
        "recon/daemon/node.py:run_and_record_error",
        "recon/daemon/output.py:save",
        "recon/daemon/output.py:save_fallbacks",
        "extras/jobs/template.py:run_call",
        "recon/cli.py:run",
        "viewer/sources.py:_work",
        "viewer/window.py:call",
    },
    "what is left out is no frame, no keyframe and no result: a name, a reason, a picture, a figure": {
        "capture/status.py:last_run",
        "capture/messaging/keyframe_queue.py:_quarantine_frame",
        "capture/messaging/pubsub.py:_send",
        "capture/messaging/pubsub.py:receive",
        "capture/process/library_lines.py:_create_file",
        "capture/process/library_lines.py:_find_memory",
        "capture/process/library_lines.py:tell_last_words",
        "capture/messaging/keyframe_queue.py:mark_seen",
        "capture/messaging/keyframe_queue.py:take",
        "extras/batch/command.py:make_data_url",
        "recon/core/__init__.py:_processor_flags",
        "recon/doctor.py:_core",
        "recon/doctor.py:_gpu",
        "recon/doctor.py:_network",
        "recon/doctor.py:_check_learned_parts",
        "recon/doctor.py:_lpips",
        "extras/evaluate/runner.py:run_to_end",
        "extras/evaluate/report.py:_read_processor_name",
        "extras/jobs/__init__.py:add_sibling_cores",
        "extras/jobs/__init__.py:_busy_s",
        "extras/jobs/__init__.py:free_core",
        "extras/jobs/launch.py:main",
        "extras/jobs/__init__.py:tree_mb",
        "extras/jobs/__init__.py:_children",
        "extras/jobs/template.py:_copy",
        "extras/jobs/template.py:_become",
        "recon/result/report.py:peak_rss_mb",
    },
    "it takes neither a descriptor nor memory: a name is removed, a socket shut, a lock or a kind asked for": {
        "capture/cameras/folder.py:_may_be_file",
        "capture/messaging/network.py:_is_let_in",
        "capture/messaging/network.py:_peer",
        "capture/messaging/network.py:_shut",
        "capture/messaging/keyframe_queue.py:_keep_bound",
        "capture/process/files.py:remove_leftovers",
        "capture/process/files.py:write_atomically",
        "capture/process/files.py:_remove_if_empty",
        "capture/process/python.py:is_current_folder",
        "capture/process/terminal.py:_is_closed_pipe",
        "capture/cameras/v4l2.py:close",
        "extras/batch/__init__.py:_is",
        "extras/jobs/ray.py:_apply",
        "recon/result/export/__init__.py:remove_result",
        "recon/result/export/staged.py:_remove",
        "recon/result/export/staged.py:_write_files",
        "recon/result/export/staged.py:_write_through",
        "viewer/web/__init__.py:_hang_up",
    },
    "it runs in a process of its own, with a file that is open already": {
        "capture/av.py:_decode",
        "capture/av.py:_packets",
        "capture/av.py:_packets_from",
        "extras/pyarrow.py:_answer",
    },
}


def test_a_shortage_is_never_held_for_the_fault_of_a_file():
    found = {each for room in ROOMS for path in sorted((ROOT / room).rglob("*.py")) for each in _careless(path)}
    known = set[str]().union(*HARMLESS.values())
    assert not found - known, f"ask raise_shortage there, or say here why a shortage is harmless: {found - known}"
    assert not known - found, f"no longer so: {known - found}"


def test_the_rule_sees_what_it_is_for(tmp_path):
    careless = "def read():\n    try:\n        pass\n    except (ValueError, OSError):\n        return None\n"
    (tmp_path / "one.py").write_text(careless)
    (tmp_path / "two.py").write_text(careless.replace("except (ValueError, OSError)", "except KeyError"))
    (tmp_path / "three.py").write_text(careless.replace("return None", "raise_shortage(error)"))
    (tmp_path / "four.py").write_text("def write():\n    with suppress(OSError):\n        pass\n")
    found = {name: [*_careless(tmp_path / f"{name}.py")] for name in ("one", "two", "three", "four")}
    assert {name for name, each in found.items() if each} == {"one", "four"}


def _careless(path: Path) -> Iterator[str]:
    """FILE:FUNCTION of each handler that neither raises nor asks."""
    shown = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
    tree = ast.parse(path.read_text())
    for function in (each for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)):
        if any(_is_careless(each) for each in _within(function)):
            yield f"{shown}:{function.name}"


def _within(function: ast.FunctionDef) -> Iterator[ast.stmt]:
    """Statements of the function, without those of functions within it."""
    rest: list[ast.AST] = [*function.body]
    while rest:
        node = rest.pop()
        if isinstance(node, ast.FunctionDef):
            continue
        if isinstance(node, ast.stmt):
            yield node
        rest += ast.iter_child_nodes(node)


def _is_careless(statement: ast.stmt) -> bool:
    if isinstance(statement, ast.With):
        contexts = [each.context_expr for each in statement.items]
        return any({"suppress"} <= _names(each) and _names(each) & WIDE for each in contexts) and not _asks(
            statement.body
        )
    if not isinstance(statement, ast.Try) or _asks(statement.body):
        return False
    wide = [each for each in statement.handlers if each.type is None or _names(each.type) & WIDE]
    return any(not _asks(each.body) and not _raises(each.body) for each in wide)


def _names(node: ast.AST) -> set[str]:
    found = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
    return found | {each.attr for each in ast.walk(node) if isinstance(each, ast.Attribute)}


def _asks(body: list[ast.stmt]) -> bool:
    return any(_names(each) & ASKS for each in body)


def _raises(body: list[ast.stmt]) -> bool:
    return any(isinstance(node, ast.Raise) for each in body for node in ast.walk(each))
