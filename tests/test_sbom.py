"""The bill of materials: all that is needed, once, and nothing that only tests need."""

from __future__ import annotations

from importlib import metadata

from tests.licences import required
from tests.sbom import bill
from tests.test_packaging import PROJECT, declared


def test_the_base_is_required_and_extras_are_optional() -> None:
    scopes = {one["name"]: one["scope"] for one in bill()["components"]}
    base = required({name.lower() for name in declared(PROJECT["dependencies"])})
    assert {name for name, scope in scopes.items() if scope == "required"} == base
    assert {scopes[name] for name in ("viser", "zarr", "netcdf4", "distributed", "sgp4")} == {"optional"}
    assert scopes.keys().isdisjoint({"pytest", "hypothesis", "mypy", "magpylib", "magloc"})


def test_components_are_what_is_installed() -> None:
    for one in bill()["components"]:
        assert one["version"] == metadata.version(one["name"])
        assert one["purl"] == f"pkg:pypi/{one['name']}@{one['version']}"
        assert one["licenses"][0]["license"]["name"] not in {"", "unknown"}


def test_every_component_is_reached_from_the_root() -> None:
    graph = {one["ref"]: one["dependsOn"] for one in bill()["dependencies"]}
    found, last = {"magloc"}, {"magloc"}
    while last:
        last = {needed for name in last for needed in graph[name]} - found
        found |= last
    names = [one["bom-ref"] for one in bill()["components"]]
    assert sorted(found - {"magloc"}) == names
    assert graph.keys() == found
