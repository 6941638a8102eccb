"""The image's locked dependencies match pyproject.toml, with hashes, for each Python and processor."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT: Final = Path(__file__).parents[2]
PROJECT: Final[dict[str, Any]] = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS: Final = re.findall(r"^IMAGE_EXTRAS = (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[
    0
].split()
ENVIRONMENTS: Final = [
    (python, machine) for python in ("3.11", "3.13", "3.14") for machine in ("x86_64", "aarch64")
]


def read_lock(name: str) -> dict[str, list[tuple[Requirement, int]]]:
    """Return the pins of each package, one per marker, and the number of hashes of each pin."""
    pins: dict[str, list[tuple[Requirement, int]]] = {}
    text = re.sub(r"\\\n", " ", (ROOT / "packaging" / f"requirements-{name}.txt").read_text())
    for line in text.splitlines():
        if line and not line.lstrip().startswith("#"):
            requirement, *hashes = re.split(r"\s+--hash=sha256:", line.strip())
            found = Requirement(requirement)
            pins.setdefault(canonicalize_name(found.name), []).append((found, len(hashes)))
    return pins


def required(name: str) -> list[Requirement]:
    """Return the requirements of a lock: of nedbus and its extras, or of a dependency group."""
    project = PROJECT["project"]
    if name == "build":
        texts = PROJECT["dependency-groups"]["sbom"]
    else:
        texts = [
            *project["dependencies"],
            *(each for extra in EXTRAS for each in project["optional-dependencies"][extra]),
        ]
    return [each for each in map(Requirement, texts) if each.name != "nedbus"]


@pytest.mark.parametrize("name", ["image", "build"])
@pytest.mark.parametrize(("python", "machine"), ENVIRONMENTS)
def test_lock_satisfies_pyproject(name: str, python: str, machine: str) -> None:
    """Each requirement has exactly one pin per environment, which satisfies it and has hashes (`make lock`)."""
    environment = {key: str(value) for key, value in default_environment().items()}
    environment |= {"python_version": python, "python_full_version": f"{python}.0"}
    environment |= {"platform_machine": machine, "sys_platform": "linux", "extra": ""}
    pins = read_lock(name)
    for requirement in required(name):
        own = [
            (pin, hashes)
            for pin, hashes in pins.get(canonicalize_name(requirement.name), [])
            if pin.marker is None or pin.marker.evaluate(environment)
        ]
        assert len(own) == 1, f"{requirement}: {own}; run `make lock`"
        [(pin, hashes)] = own
        [version] = pin.specifier
        assert version.operator == "=="
        assert requirement.specifier.contains(version.version), (
            f"{pin} is not {requirement}; run `make lock`"
        )
        assert hashes


@pytest.mark.parametrize("name", ["image", "build"])
def test_each_pin_has_hashes(name: str) -> None:
    assert all(hashes for pins in read_lock(name).values() for _, hashes in pins)


@pytest.mark.parametrize("name", ["image", "build"])
def test_lock_contains_no_urls(name: str) -> None:
    """The lock identifies files by their hashes, not by their origin."""
    text = (ROOT / "packaging" / f"requirements-{name}.txt").read_text()
    assert not re.search(r"://|index-url|find-links", text)


def test_image_has_all_extras_except_foxglove_and_plot() -> None:
    """A new extra must be added to IMAGE_EXTRAS in the Makefile, or excluded here."""
    extras = {*PROJECT["project"]["optional-dependencies"]} - {"all"}
    assert {*EXTRAS} == extras - {"foxglove", "plot"}
