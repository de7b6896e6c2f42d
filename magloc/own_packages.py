"""Check that no other distribution has installed a package with one of our names."""

import os
from importlib.util import find_spec

_HERE = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))


def refuse_foreign_packages() -> None:
    """Raise ImportError if `arrays` or `sims` was not installed with magloc."""
    for name in ("arrays", "sims"):
        spec = find_spec(name)
        path = "" if spec is None else spec.origin or "".join(list(spec.submodule_search_locations or ())[:1])
        if os.path.dirname(os.path.dirname(os.path.realpath(path))) != _HERE:
            raise ImportError(
                f"magloc found the package {name} {f'at {path}' if path else 'nowhere'}, expected its own in {_HERE}:"
                " another distribution has installed that name. Install magloc into a separate environment."
            )
