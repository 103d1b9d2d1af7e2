"""The build backend (PEP 517, 660): setuptools, with the C++ core compiled before a wheel or an editable install.

Where no compiler is installed, the build asks for the one that PyPI carries as `ziglang`. The core is loaded with
ctypes, so a wheel is tied to a platform but to no version of Python.
"""

from __future__ import annotations

import shutil
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

from splatnode.recon.core.compile import TARGETS, compile_core, find_compiler, platform_tag

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

Settings = dict[str, Any] | None


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    return build_meta.get_requires_for_build_wheel(config_settings) + _compiler_requirement()


def get_requires_for_build_editable(config_settings: Settings = None) -> list[str]:
    return build_meta.get_requires_for_build_editable(config_settings) + _compiler_requirement()


def build_wheel(wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None) -> str:
    """The wheel's file name, tagged py3-none-<platform>.

    With the setting `target`, one of TARGETS, it is for that kind of machine; see recon/core/release.py.
    """
    settings = dict(config_settings or {})
    target = TARGETS[settings.pop("target")] if "target" in settings else None
    compile_core(target=target)
    shutil.rmtree("build/lib", ignore_errors=True)  # setuptools would pack modules left there by an earlier version
    given = settings.get("--build-option", [])
    settings["--build-option"] = ["--plat-name", platform_tag(target), *([given] if isinstance(given, str) else given)]
    return build_meta.build_wheel(wheel_directory, settings, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    compile_core()
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


def _compiler_requirement() -> list[str]:
    return [] if find_compiler() else ["ziglang"]
