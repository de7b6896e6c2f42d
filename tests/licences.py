"""``python -m tests.licences``: the licence of everything that is installed with magloc; 1 if the base has copyleft."""

from __future__ import annotations

import re
import sys
from importlib import metadata

from tests.test_packaging import EXTRAS, GROUPS, PROJECT, declared

# Licences that reach further than to the files that are under them.
COPYLEFT = re.compile(r"\b[AL]?GPL|\bGeneral Public License|\bEUPL|\bCC-BY-SA", re.IGNORECASE)
# Whose GPL is that of a file which is not part of what is installed.
BESIDE = {"docutils": "public domain, BSD-2-Clause (the GPL is that of an editor's mode)"}


def required(names: set[str]) -> set[str]:
    """These distributions and all that they need in turn, as far as they are installed; extras are not followed."""
    found: set[str] = set()
    while names:
        found |= names
        names = {needed for name in names for needed in needs(name)} - found
    return found


def needs(name: str) -> set[str]:
    """What a distribution needs itself, as far as it is installed."""
    needed = (line for line in metadata.requires(name) or [] if "extra ==" not in line)
    return {installed(re.match(r"[\w.-]+", line)[0]) for line in needed} - {""}


def installed(name: str) -> str:
    """Its name in lower case, or nothing: a marker may say that this machine has no need of it."""
    try:
        return metadata.distribution(name).name.lower().replace("_", "-")
    except metadata.PackageNotFoundError:
        return ""


def licence(name: str) -> str:
    """What a distribution says of itself: an expression, classifiers, or the first line of a text."""
    if name in BESIDE:
        return BESIDE[name]
    data = metadata.metadata(name)
    classifiers = [line.rpartition(" :: ")[2] for line in data.get_all("Classifier") or [] if "License ::" in line]
    text = data.get("License-Expression") or ", ".join(classifiers) or data.get("License") or "unknown"
    return text.splitlines()[0]


def copyleft(names: set[str]) -> list[str]:
    """Those of some distributions that are under copyleft, or do not say."""
    return sorted(name for name in names if COPYLEFT.search(licence(name)) or licence(name) == "unknown")


def main() -> int:
    """List them."""
    base = required({installed(name) for name in declared(PROJECT["dependencies"])})
    optional = [*EXTRAS.values(), GROUPS["test"], GROUPS["bench"]]
    of_extras = {installed(name) for some in optional for name in declared(some)} - {""}
    for title, names in (("base", base), ("extras", required(of_extras) - base)):
        print(f"{title}:")
        for name in sorted(names):
            print(f"  {name:28s}{metadata.version(name):18s}{licence(name)}")
    for name in copyleft(base):
        print(f"copyleft in the base: {name}, {licence(name)}", file=sys.stderr)
    return 1 if copyleft(base) else 0


if __name__ == "__main__":
    sys.exit(main())
