"""Pages that are made when the site is built: of the command lines, of the notebooks, and what links code to theory."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

HERE = Path(__file__).parent
NOTEBOOKS = HERE.parent / "notebooks"
# As a page of the gallery names that folder.
ORIGINALS = "../../../notebooks"
# How a docstring names a page of the theory.
PAGE = re.compile(r"docs/theory/([\w-]+)\.md")
# A link of a command's page to a heading that is on another page now.
LINK = re.compile(r"^(\* )\[(`[\w-]+`)\]\(#[\w-]+\)", re.MULTILINE)
# The picture of what a function finds or draws, on the function's page.
PICTURES = {
    "notebook-01-first-fix.png": ["magloc.locate", "magloc.Fixes", "magloc.Fix", "magloc.plots.fixes"],
    "notebook-09-several-sources.png": ["magloc.Solution"],
    "track-weaving.png": ["magloc.track", "magloc.Track", "magloc.Tracker", "magloc.plots.track"],
    "track-three-magnets.png": ["magloc.track_sources", "magloc.SourcesTrack", "magloc.SourcesTracker"],
    "notebook-08-calibration.png": ["magloc.calibrate", "magloc.Calibration", "magloc.plots.calibration"],
    "bounds-reach.png": ["magloc.cramer_rao_bounds", "magloc.Bounds", "magloc.bound_map", "magloc.plots.bound_reach"],
    "design-half-space.png": ["magloc.design_array", "magloc.Design"],
    "convergence-paper.png": ["magloc.convergence_map", "magloc.plots.convergence"],
    "view-dipole.png": ["magloc.view", "arrays.mesh_of"],
    "notebook-10-ship.png": ["magloc.fit_signature", "magloc.Signature"],
    "view-map.png": ["magloc.source_map"],
    "view-array.png": ["arrays.SensorArray", "arrays.tetrahedron", "arrays.read_array"],
    "gradient-tensor.png": ["magloc.fit_gradient_tensor", "magloc.GradientTensor"],
    "residuals-faulty.png": ["magloc.plots.residuals"],
    "attitude-track.png": ["adcs.estimate", "adcs.AttitudeTrack"],
    "attitude-complementary.png": ["adcs.complementary_filter"],
    "view-mockup.png": ["adcs.mockup.fuse", "adcs.mockup.DelayedFilter"],
}
# The page of the guide on which a name, or all of a module, is explained; the other names of the page are related.
EXPLAINED = {
    "array-design": "magloc.design_array magloc.Design magloc.DesignTask",
    "array-files": "arrays.SensorArray arrays.Sensor arrays.Calibration arrays.SensorPreset arrays.read_array"
    " arrays.read_sensors arrays.write_array arrays.array_toml arrays.mesh_of arrays.tetrahedron arrays.square"
    " arrays.cross arrays.cube arrays.hexagon arrays.axial arrays.grid",
    "attitude": "adcs.estimate adcs.EstimatorSettings adcs.Telemetry adcs.read_telemetry adcs.Satellite"
    " adcs.circular_orbit adcs.read_scenario adcs.find_own_fields adcs.OwnFields"
    " adcs.BDot adcs.b_dot_gain adcs.detumbled adcs.read_oem adcs.read_aem adcs.write_oem adcs.write_aem"
    " adcs.AttitudeTrack adcs.EllipsoidObserver adcs.BoundedSystem"
    " adcs.Ellipsoid sims.AttitudeScenario sims.experiments.run_scenario sims.experiments.compared_with_paper",
    "calibration": "magloc.calibrate magloc.Calibration magloc.CalibrationPrior magloc.plots.calibration",
    "convergence-maps": "magloc.convergence_map magloc.source_map magloc.RepeatedFilter magloc.moments_on_sphere"
    " magloc.plots.convergence magloc.plots.sources",
    "detection-range-and-bounds": "magloc.cramer_rao_bounds magloc.Bounds magloc.bound_map magloc.detection_range"
    " magloc.MatchedFilterDetector magloc.plots.bound_reach magloc.plots.bound_slices magloc.plots.bound_sphere",
    "dipole-moment": "magloc.equivalent_dipole",
    "exporting": "magloc.plots.save magloc.plots.write",
    "figures-and-viewer": "magloc.view magloc.plots.design",
    "gradient-tensor": "magloc.fit_gradient_tensor magloc.GradientTensor",
    "inertial-unit": "adcs.complementary_filter adcs.inertial_magnetic_filter adcs.read_imu"
    " adcs.HeadingModel adcs.Gains",
    "iterated-kalman-filter": "magloc.IteratedExtendedKalmanFilter",
    "live": "magloc.live magloc.viewer",
    "localization": "magloc.locate magloc.Locator magloc.Fixes magloc.Fix magloc.Solution magloc.Source"
    " magloc.SourcePrior magloc.plots.fixes",
    "moving-arrays": "magloc.MeasuredMotion magloc.KnownMotion",
    "monte-carlo": "sims.run_many sims.simulate sims.read_scenario sims.MagneticScenario sims.write_simulation",
    "reading-data": "magloc.read_readings magloc.Readings magloc.read_truth magloc.Truth arrays.InputError",
    "sensor-faults": "magloc.plots.residuals",
    "ship-signature": "magloc.track_moment magloc.track_moments magloc.MomentTrack magloc.ObjectPath magloc.PathError"
    " magloc.read_object_path magloc.fit_signature magloc.Signature",
    "single-sensor-ranging": "magloc.SourceLine magloc.fit_source_line magloc.distance_along_line",
    "star-identification": "adcs.solve_photograph adcs.identify_stars adcs.read_picture adcs.combined_star_fixes"
    " adcs.hipparcos_catalogue",
    "table-top-satellite": "adcs.mockup sims.table_run sims.TableScenario sims.CameraErrors sims.rendered_frame"
    " sims.experiments.sky_run sims.experiments.identified_files sims.experiments.fused_runs"
    " sims.experiments.fused_record sims.experiments.zeros_run",
    "tracking": "magloc.track magloc.Track magloc.Tracker magloc.RandomWalk magloc.OrnsteinUhlenbeck"
    " magloc.CoordinatedTurn magloc.FreeMotion magloc.track_sources magloc.SourcesTrack magloc.SourcesTracker"
    " magloc.subtract_rest magloc.plots.track magloc.plots.consistency",
}
# Other pages that a function's page names at most of each folder, in this order.
MOST_PAGES = {"guide": 3, "theory": 2, "gallery": 2}
# What a bar stands in: literal text and formulas keep it, elsewhere it would be a substitution.
BAR = re.compile(r"(``.*?``|:math:`[^`]*`)|\\?\|")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    # Before autosummary, which looks at the same event for what it has to make.
    app.connect("builder-inited", make_all, priority=100)
    # Before numpydoc, which makes other lines of them.
    app.connect("autodoc-process-docstring", readable, priority=100)
    # After numpydoc, which would take it for a part of the last section.
    app.connect("autodoc-process-docstring", illustrated, priority=900)
    app.connect("doctree-read", link_names)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def make_all(app: Sphinx) -> None:
    """Write what git does not keep: commands, notebooks, MathJax."""
    commands = fresh(HERE / "reference" / "commands")
    for name, text in command_pages():
        (commands / f"{name.replace(' ', '-')}.md").write_text(text, encoding="utf-8")
    notebooks = fresh(HERE / "gallery" / "notebooks")
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        drawing = [cell for cell in notebook["cells"] if pictures([cell])]
        for cell in drawing:
            if "plt." in "".join(cell["source"]):  # what the library or a command draws takes a line or two
                cell["metadata"]["tags"] = ["hide-input"]
        notebook["cells"][0]["source"] += [f"\n\n{{download}}`Download this notebook <{ORIGINALS}/{path.name}>`"]
        (notebooks / path.name).write_text(json.dumps(notebook), encoding="utf-8")
        (notebooks / f"{path.stem}.png").write_bytes(pictures(drawing)[0])
    app.config.html_static_path.append(str(mathjax(fresh(HERE / "_build" / "mathjax"))))


def fresh(folder: Path) -> Path:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def pictures(cells: list[dict[str, Any]]) -> list[bytes]:
    """Those among the kept outputs of a notebook."""
    outputs = (output.get("data", {}) for cell in cells for output in cell.get("outputs", []))
    return [base64.b64decode(data["image/png"]) for data in outputs if "image/png" in data]


def command_pages() -> Iterator[tuple[str, str]]:
    """Name and page of every command, from the help that the command prints."""
    from adcs.cli.app import app as adcs
    from magloc.cli.app import app as magloc
    from magloc.cli.framework import use_docstrings

    for app in (magloc, adcs):
        for tokens in ([name, *inner] for name in app for inner in ([], *([other] for other in app[name]))):
            use_docstrings(app, tokens)
        text = app.generate_docs(output_format="markdown", recursive=True)
        for part in re.split(r"^## (?=(?:magloc|adcs) )", text, flags=re.MULTILINE)[1:]:
            name, _, rest = part.partition("\n")
            rest = LINK.sub(r"\1\2", rest)
            yield name, f"# {name}\n{re.sub(r'^###', '##', rest, flags=re.MULTILINE)}"


def mathjax(folder: Path) -> Path:
    """A folder with MathJax as one file, from the package that carries it."""
    package = find_spec("sphinx-mathjax-offline")
    if package is None or package.submodule_search_locations is None:
        raise ModuleNotFoundError("formulas need MathJax: pip install sphinx-mathjax-offline")
    [place] = package.submodule_search_locations
    shutil.copy(Path(place) / "static" / "mathjax" / "tex-svg-full.js", folder / "mathjax.js")
    return folder


def readable(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Make links of the pages of the theory that a docstring names, and a modulus of every pair of bars."""
    text = "\n".join(BAR.sub(lambda part: part[1] or r"\|", PAGE.sub(r":doc:`/theory/\1`", line)) for line in lines)
    if what == "module":
        text = text.replace("References\n----------\n", ".. rubric:: References\n\n")
    lines[:] = text.split("\n")


def illustrated(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Add the picture of a public name, and the pages where it is used."""
    for picture, names in PICTURES.items():
        if name in names:
            lines += ["", f".. image:: /{picture}", f"   :alt: What {name} finds or draws", "   :width: 75%"]
    pages, related = see_also(name) if what in ("function", "class") else ([], [])
    if pages:
        lines += ["", ".. rubric:: See also", "", *(f"- :doc:`/{page}`" for page in pages)]
        lines += ["- " + ", ".join(f":py:obj:`{other}`" for other in related), ""] if related else [""]


def see_also(name: str) -> tuple[list[str], list[str]]:
    """Pages for a public name, that of its explanation first, and the names that are explained there too."""
    explained = {f"guide/{page}": names.split() for page, names in EXPLAINED.items()}
    own = {page: names for page, names in explained.items() if {name, name.rpartition(".")[0]} & {*names}}
    uses = {page: len(re.findall(rf"\b{re.escape(name)}\b(?!\.\w)", text)) for page, text in texts().items()}
    others = sorted((page for page, count in uses.items() if count and page not in own), key=lambda page: -uses[page])
    pages = [page for folder, most in MOST_PAGES.items() for page in [o for o in others if o.startswith(folder)][:most]]
    return [*own, *pages], [other for names in own.values() for other in names if other != name]


@cache
def texts() -> dict[str, str]:
    """What the pages of guide, theory and gallery say, by the name of the page."""
    pages = [*sorted((HERE / "guide").glob("*.md")), *sorted((HERE / "theory").glob("*.md"))]
    notebooks = sorted((HERE / "gallery" / "notebooks").glob("*.ipynb"))
    found = {page: page.read_text(encoding="utf-8") for page in pages if page.stem != "index"}
    for page in notebooks:
        cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
        found[page] = "\n".join("".join(cell["source"]) for cell in cells)
    return {str(page.relative_to(HERE).with_suffix("")): text for page, text in found.items()}


def link_names(app: Sphinx, doctree: nodes.document) -> None:
    """Make a link to the reference of every public name that stands in a text as code."""
    for literal in list(doctree.findall(nodes.literal)):
        if literal.astext() in public_names() and not isinstance(literal.parent, (nodes.reference, pending_xref)):
            target = {"refdomain": "py", "reftype": "obj", "reftarget": literal.astext(), "refexplicit": False}
            link = pending_xref("", refdoc=app.env.current_document.docname, refwarn=False, **target)
            literal.replace_self(link)
            link += literal


@cache
def public_names() -> frozenset[str]:
    """All of them, with their package."""
    packages = [import_module(package) for package in ("arrays", "magloc", "adcs", "sims")]
    return frozenset(f"{package.__name__}.{name}" for package in packages for name in package.__all__)
