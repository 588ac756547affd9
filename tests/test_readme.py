"""The documentation: its Python blocks run as they stand, its commands parse, and its pages lead to each other."""

import json
import re
import runpy
import warnings
from pathlib import Path

import ezdxf
import laspy
import matplotlib.pyplot as plt
import numpy as np
import pytest
import typer
from rosbag_files import write_drive

from sionna_partial.cli.app import app
from sionna_partial.resources import scenes_folder

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
BENCHMARKS = ROOT / "benchmarks" / "README.md"
PAGES = (README, ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", BENCHMARKS, *sorted((ROOT / "docs").glob("*.md")))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def links(page: Path) -> list[tuple[Path, str]]:
    targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    parts = [target.partition("#") for target in targets if "://" not in target]
    return [((page.parent / name).resolve() if name else page, anchor) for name, _, anchor in parts]


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def write_scans(folder: Path) -> None:
    write_drive(folder / "drive.bag")
    rng = np.random.default_rng(0)
    cloud = rng.uniform((0, 0, 0), (5, 3, 2.5), (60_000, 3))
    cloud[:30_000, 2] = np.where(rng.random(30_000) < 0.5, 0.0, 2.5)
    side = rng.integers(0, 4, 30_000)
    for number, (axis, value) in enumerate(((0, 0.0), (0, 5.0), (1, 0.0), (1, 3.0))):
        cloud[30_000:][side == number, axis] = value
    scan = laspy.create()
    scan.x, scan.y, scan.z = cloud.T
    scan.write(folder / "scan.laz")
    plan = ezdxf.new(units=4)
    corners = [(0, 0), (5000, 0), (5000, 4000), (0, 4000)]
    plan.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "A-WALL-FULL"})
    plan.saveas(folder / "plan.dxf")
    from ifc_building import Building  # needs an extra

    building = Building(0.0, 3.0)
    building.rooms(0.0, 0)
    building.rooms(3.0, 1)
    building.model.write(str(folder / "building.ifc"))


PAGES_WITH_PYTHON = tuple(page for page in PAGES if blocks(page, "python"))


@pytest.mark.pages
@pytest.mark.parametrize("page", PAGES_WITH_PYTHON, ids=lambda page: page.name)
def test_python_blocks_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They read `scenes/`, or a scan of the reader's; each file that they write is there, and what they say they print.

    The pages share a process, as libraries take longer to import than most pages to run: the order is checked here.
    """
    (tmp_path / "scenes").symlink_to(scenes_folder())
    write_scans(tmp_path)
    code = "".join(blocks(page, "python"))
    libraries = re.findall(
        r"^ *(?:import|from) (sionna_partial|sionna|mitsuba|drjit|tensorflow|keras)\b", code, re.MULTILINE
    )
    assert libraries[0] == "sionna_partial"
    (tmp_path / "page.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(action="default"):
        runpy.run_path("page.py", run_name="__main__")
    plt.close("all")
    printed = capsys.readouterr().out.splitlines()
    for line in re.findall(r"^print\(.*\)  # prints (.*)$", code, flags=re.MULTILINE):
        assert line in printed
    written = re.findall(r"(?:save\w*|animate_exploration|export_scene)\(.*?\"([^\"]+)\"\)", code)
    for name in written:
        path = tmp_path / name
        assert (path / "scene.xml" if path.is_dir() else path).stat().st_size > 100, name


def test_commands_and_their_options_exist() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES).replace("\\\n", " ")
    commands = re.findall(r"(?:^ *|`|/bin/)sionna-partial ([a-z-]+)([^`\n]*)", text, flags=re.MULTILINE)
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert len(commands) > 8
    for name, arguments in commands:
        options = {
            option for parameter in known[name].params for option in (*parameter.opts, *parameter.secondary_opts)
        }
        assert set(re.findall(r"--[a-z-]+", arguments)) <= {*options, "--help"}, f"{name}{arguments}"


def test_linked_files_and_headings_exist() -> None:
    for page, (target, anchor) in ((each, link) for each in PAGES for link in links(each)):
        assert target.is_file(), f"{page.name} links to {target}"
        assert not anchor or anchor in anchors(target), f"{page.name} links to {target.name}#{anchor}"


def test_every_page_and_picture_is_linked() -> None:
    linked = {target for page in PAGES for target, _ in links(page)}
    reached, new = set[Path](), {README}
    while new:
        reached |= new
        new = {target for page in new for target, _ in links(page) if target in PAGES} - reached
    assert reached == set(PAGES)
    assert {picture for end in ("png", "svg") for picture in (ROOT / "docs").glob(f"*.{end}")} <= linked
    for page in PAGES[1:]:
        assert README in {target for target, _ in links(page)}, f"{page.name} does not lead back"


def test_dates_of_figures_are_in_the_table_of_benchmarks() -> None:
    for page in (ROOT / "docs").glob("*.md"):
        assert not re.search(r"\b20\d\d-\d\d-\d\d\b|\bcommit [0-9a-f]{7}", page.read_text("utf-8")), page.name


def test_every_command_is_in_the_table() -> None:
    table = (ROOT / "docs" / "start.md").read_text("utf-8").partition("| `sionna-partial` command | result |")[2]
    rows = re.findall(r"^\| (`[^|]*) \|", table, flags=re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`([a-z-]+)", row)}
    assert named == typer.main.get_command(app).commands.keys()  # type: ignore[attr-defined]


def test_only_the_repository_is_installed_from() -> None:
    for path in (*PAGES, *(file for end in ("py", "md", "ipynb") for file in ROOT.glob(f"[des]*/**/*.{end}"))):
        assert not re.search(r"pip install ['\"]?sionna-partial", path.read_text("utf-8")), (
            f"{path} installs from an index"
        )


def test_pages_and_sections_named_in_code_exist() -> None:
    for folder in ("sionna_partial", "docs", "tests", "examples", "benchmarks"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".md", ".ipynb", ".html", ".rst"):
                text = path.read_text("utf-8")
                for name in re.findall(r"\bdocs/[\w/]+\.\w+", text):
                    assert (ROOT / name).exists(), f"{path.name} names {name}"
                for name, section in re.findall(r"\b(docs/\w+\.md), ([A-Z][\w ]+)", text):
                    assert section.lower().replace(" ", "-") in anchors(ROOT / name), f"{path.name} cites {section}"


def test_notebooks_are_stored_without_outputs_and_link_to_files_and_headings() -> None:
    for notebook in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        assert not [cell for cell in cells if cell.get("outputs")], f"{notebook.name}: clear its outputs"
        text = "".join(line for cell in cells for line in cell["source"])
        for target, anchor in re.findall(r"\]\(([^):#]+)#?([^)]*)\)", text):
            page = (notebook.parent / target).resolve()
            assert not page.suffix or page.is_file(), f"{notebook.name} links to {target}"
            assert not anchor or anchor in anchors(page), f"{notebook.name} links to {target}#{anchor}"


def test_files_named_in_code_exist() -> None:
    for page in PAGES:
        folders = r"\b(?:benchmarks|examples|scenes|sionna_partial)"
        for name in re.findall(rf"{folders}/[\w/]+(?:\.\w+)+", page.read_text("utf-8")):
            assert (ROOT / name).exists(), f"{page.name} names {name}"


def test_every_benchmark_is_in_the_table_and_on_its_page() -> None:
    """Scripts without a page hold functions that other scripts import."""
    table = BENCHMARKS.read_text("utf-8")
    scripts = {path.name: path.read_text("utf-8") for path in BENCHMARKS.parent.glob("*.py")}
    rows = [row for row in table.splitlines() if row.startswith("| [`")]
    named = [name for row in rows for name in re.findall(r"\[`(\w+\.py)`\]\(", row)]
    assert sorted(named) == sorted(scripts)
    for row in rows:
        pages = [BENCHMARKS.parent / target for target in re.findall(r"\]\((\.\./docs/[^)]+)\)", row)]
        for name in re.findall(r"`(\w+\.py)`", row):
            if pages:
                assert any(name in page.read_text("utf-8") for page in pages), f"{name}: no figure on its page"
            else:
                module = re.compile(rf"^from {name.removesuffix('.py')} import", flags=re.MULTILINE)
                assert any(module.search(text) for text in scripts.values()), f"{name} has no page"


def test_rooms_are_described() -> None:
    text = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
    folders = [path.parent.name for path in (ROOT / "sionna_partial").glob("*/__init__.py")]
    assert [name for name in folders if f"`{name}/`" not in text] == []


def test_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_make_targets_that_are_named_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in {
        name for page in PAGES for name in re.findall(r"`make ([a-z-]+)`", page.read_text(encoding="utf-8"))
    }:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
