"""The container image and the SBOM that it contains."""

from __future__ import annotations

import json

import pytest

import nedbus

from .stack import docker

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]


def run_in_image(*command: str) -> str:
    """Run a command in the image instead of nedbus, and return its output."""
    return docker("run", "--rm", "--entrypoint", command[0], "nedbus", *command[1:])


def test_sbom_lists_installed_packages(images: None) -> None:
    """The SBOM lists exactly the packages installed in the image, with versions, and no build tools."""
    sbom = json.loads(run_in_image("cat", "/opt/nedbus/sbom.cdx.json"))
    root = sbom["metadata"]["component"]
    listed = {
        each["purl"].removeprefix("pkg:pypi/").partition("?")[0] for each in [*sbom["components"]]
    }
    code = (
        "import importlib.metadata as m, re;"
        "print(*(f\"{re.sub('[-_.]+', '-', each.name).lower()}@{each.version}\" for each in m.distributions()))"
    )
    installed = {*run_in_image("/opt/nedbus/bin/python", "-I", "-c", code).split()}
    assert (root["name"], root["version"]) == ("nedbus", nedbus.__version__)
    assert {f"nedbus@{nedbus.__version__}", *listed} == installed
    assert not any(name.startswith(("pip@", "hatchling@", "cyclonedx")) for name in installed)
