"""``python -m tests.sbom``: what magloc needs when it runs, as it is installed, as CycloneDX JSON on stdout."""

from __future__ import annotations

import json
import sys
from importlib import metadata
from typing import Any

from tests.licences import installed, licence, needs, required
from tests.test_packaging import PROJECT, declared


def bill() -> dict[str, Any]:
    """The base as required components, what the extras of a user add as optional ones, and which needs which."""
    direct = {installed(name) for name in declared([*PROJECT["dependencies"], "magloc[all]"])} - {""}
    base = required({installed(name) for name in declared(PROJECT["dependencies"])})
    names = sorted(required(direct))
    root = {"type": "application", "name": PROJECT["name"], "version": PROJECT["version"], "bom-ref": "magloc"}
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": {**root, "licenses": [{"expression": PROJECT["license"]}]}},
        "components": [component(name, "required" if name in base else "optional") for name in names],
        "dependencies": [
            {"ref": "magloc", "dependsOn": sorted(direct)},
            *({"ref": name, "dependsOn": sorted(needs(name))} for name in names),
        ],
    }


def component(name: str, scope: str) -> dict[str, Any]:
    """One distribution; its licence as it states it, for not all of them state one of SPDX's list."""
    version = metadata.version(name)
    return {
        "type": "library",
        "bom-ref": name,
        "name": name,
        "version": version,
        "scope": scope,
        "purl": f"pkg:pypi/{name}@{version}",
        "licenses": [{"license": {"name": licence(name)}}],
    }


if __name__ == "__main__":
    json.dump(bill(), sys.stdout, indent=2, ensure_ascii=False)
    print()
