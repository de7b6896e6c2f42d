"""Write the cffi declarations of the C header: ``python declare.py magloc.h _declarations.py``, called by CMake."""

import re
import sys
from pathlib import Path

from cffi import FFI

_DECLARATIONS = re.compile(r"/\* cffi reads .*?\*/(.*)/\* end of the declarations \*/", re.DOTALL)


def main(header: str, output: str) -> None:
    """Write the module that describes the functions of the header."""
    found = _DECLARATIONS.search(Path(header).read_text(encoding="utf-8"))
    if found is None:
        raise SystemExit(f"{header} has no declarations between the two comments that declare.py looks for")
    ffi = FFI()
    ffi.cdef(found[1])
    ffi.set_source("_declarations", None)
    ffi.emit_python_code(output)


if __name__ == "__main__":
    main(*sys.argv[1:])
