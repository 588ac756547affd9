"""Parts of the site besides Sphinx: its contents, the list of public names, equations without a network, figures."""

import ast
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.ext import autosummary
from sphinx_gallery.scrapers import figure_rst

ROOT = Path(__file__).resolve().parents[1]
API = ROOT / "build" / "api"
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

SECTIONS = {
    "Get started": ["docs/install", "docs/start", "docs/vacuum"],
    "Guides": [
        *("docs/maps", "docs/predict", "docs/walls", "docs/measured_powers", "docs/transmitters", "docs/channels"),
        *("docs/live", "docs/app", "docs/calibration", "docs/training", "docs/worlds", "docs/sionna_rt"),
        *(f"docs/notebooks/{path.stem}" for path in NOTEBOOKS),
        "build/gallery/index",
    ],
    "Reference": [
        *("docs/method", "docs/physics", "docs/results", "docs/model_card", "build/api/index"),
        *("docs/development", "benchmarks/README", "docs/experiments", "CONTRIBUTING", "SECURITY", "CHANGELOG"),
    ],
}
"""Pages of the sidebar, if they exist; other pages of `docs/` follow under "More"."""

ROOMS = {
    "maps": "Maps",
    "scene": "Scenes",
    "tracing": "Tracing",
    "prediction": "Prediction",
    "coverage": "Coverage",
    "export": "Coverage",
    "worlds": "Homes and robots",
    "calibration": "Calibration and placement",
    "placement": "Calibration and placement",
    "exploration": "Homes and robots",
    "differentiable": "Gradients",
    "settings": "Settings",
}
"""Headings of the API reference by room of the package; the names of other rooms follow under "More"."""

GROUPS = {
    "maps.importers": "sp.importers: maps and recordings of other formats",
    "channels": "sp.channels: channels of links",
    "plots": "sp.plots: pictures",
    "lab": "sp.lab: data sets and training",
}
"""Headings of the modules whose names are public as well."""

RETURNED = (
    *("calibration.calibration.MaterialCalibration", "channels.samples.ChannelSamples"),
    *("exploration.explore.Exploration", "exploration.next_views.NextView", "exploration.next_views.NextViews"),
    *("placement.placement.TransmitterPlacement", "placement.several.NetworkPlacement", "settings.PlacementSettings"),
    *("measurements.assimilation.Assimilation", "apps.live.coverage.LiveCoverage", "apps.live.coverage.LiveSettings"),
    "tracing.gradients.GainGradients",
)
"""Classes that are imported from their modules."""


def figures(block: tuple, block_vars: dict, gallery_conf: dict) -> str:
    """Pictures of the matplotlib figures that a block of an example has made (ours are not pyplot's)."""
    drawn = block_vars.setdefault("drawn", [])
    paths = []
    for value in list(block_vars["example_globals"].values()):
        if isinstance(value, Figure) and not any(value is figure for figure in drawn):
            drawn.append(value)
            paths.append(next(block_vars["image_path_iterator"]))
            value.savefig(paths[-1], dpi=120)
    return figure_rst(paths, gallery_conf["src_dir"])


def public_names(package: str = "") -> list[tuple[str, str]]:
    """Modules and names that the stub of a package imports from modules of ours."""
    stub = ROOT / "sionna_partial" / package.replace(".", "/") / "__init__.pyi"
    imports = [node for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
    names = [(str(node.module).partition(".")[2], alias.name) for node in imports for alias in node.names]
    return [(module, name) for module, name in names if f"{module}.{name}".lstrip(".") not in GROUPS]


def write_api() -> None:
    """Write a page that lists every public name by room, and the names of the groups."""
    names: dict[str, list[str]] = {heading: [] for heading in [*ROOMS.values(), "More"]}
    for module, name in public_names():
        names[ROOMS.get(module.partition(".")[0], "More")].append(name)
    names |= {heading: [f"{group}.{name}" for _, name in public_names(group)] for group, heading in GROUPS.items()}
    names["Results, and classes that few need"] = [*RETURNED]
    lines = ["API reference", "=============", "", ".. currentmodule:: sionna_partial", ""]
    for heading, members in names.items():
        lines += [heading, "-" * len(heading), "", ".. autosummary::", "   :toctree: .", ""]
        lines += [*(f"   {name}" for name in members), ""]
    API.mkdir(parents=True, exist_ok=True)
    listed = {f"sionna_partial.{name}" for members in names.values() for name in members}
    for page in API.glob("sionna_partial.*.rst"):  # of an earlier build, with other names
        if page.stem not in listed:
            page.unlink()
    text = "\n".join(lines)
    page = API / "index.rst"
    if not page.exists() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")


def add_contents(app: Sphinx, name: str, source: list[str]) -> None:
    """Append the table of contents to the README, which the site starts with."""
    if name != "README":
        return
    found = app.env.found_docs
    listed = {page for pages in SECTIONS.values() for page in pages}
    others = sorted(page for page in found - listed if Path(page).parent.name == "docs")
    for caption, pages in {**SECTIONS, "More": others}.items():
        there = [f"/{page}" for page in pages if page in found]
        if there:
            source[0] += "\n".join(["", "", "```{toctree}", ":hidden:", f":caption: {caption}", "", *there, "```"])


class _Links(HTMLParser):
    """Targets of the links of a page, and its anchors."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: set[str] = set()
        self.anchors: set[str] = {""}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.targets |= {value for name in ("href", "src") if (value := values.get(name))}
        self.anchors |= {value for name in ("id", "name") if (value := values.get(name))}


def finish(app: Sphinx, failure: Exception | None) -> None:
    """Make the README the first page, and check every link inside the site."""
    if failure or app.builder.format != "html":
        return
    site = Path(app.outdir)
    shutil.copyfile(site / "README.html", site / "index.html")
    pages = {}
    for page in (site / f"{name}.html" for name in app.env.found_docs):
        pages[page] = _Links()
        pages[page].feed(page.read_text(encoding="utf-8"))
    broken = []
    for page, links in pages.items():
        for link in links.targets:
            parts = urlsplit(link)
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if parts.scheme or parts.netloc:
                continue
            if not target.is_file() or (target in pages and unquote(parts.fragment) not in pages[target].anchors):
                broken.append(f"{page.relative_to(site)} links to {link}")
    if broken:
        raise ExtensionError("\n".join(["links inside the site lead nowhere:", *broken]))


def inline_math(writer: nodes.NodeVisitor, node: nodes.math) -> None:
    """Write an equation as MathML, which browsers draw themselves."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block_math(writer: nodes.NodeVisitor, node: nodes.math_block) -> None:
    """Write an equation on a line of its own as MathML."""
    writer.body.append(tex2mathml(node.astext(), as_block=True))
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect all of this with Sphinx."""
    write_api()
    autosummary.WELL_KNOWN_ABBREVIATIONS += ("eq.", "Eq.", "Fig.")  # they end no sentence
    app.connect("source-read", add_contents)
    app.connect("build-finished", finish, priority=900)  # after MyST-NB, which copies its style sheet then
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
    return {"parallel_read_safe": True}
