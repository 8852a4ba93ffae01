"""The site: blocks of its pages run, links lead somewhere, every entry and every name is there."""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

import zoo
from zoo.catalogue import CATALOGUE

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
MADE = ("models", "results", "notebooks")
WRITTEN = sorted(
    p
    for p in [*DOCS.glob("*.md"), *DOCS.glob("reference/*.md"), *ROOT.glob("*.md")]
    if p.name != "contributing.md"
)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
BUILT_IN = {"self", "cls"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hand-written pages beside those that are made, without notebooks."""
    home = tmp_path_factory.mktemp("docs")
    with from_docs("pages") as pages:
        for name, write in (("models", pages.write_models), ("results", pages.write_results)):
            (home / name).mkdir()
            write(home / name)
        pages.write_tables(home / "tables")
    return home


@contextlib.contextmanager
def from_docs(name: str) -> Iterator[object]:
    """A module of ``docs``, which is not part of the package."""
    path = list(sys.path)
    sys.path.insert(0, str(ROOT))
    try:
        yield __import__(f"docs.{name}", fromlist=[name])
    finally:
        sys.path[:] = path


def names(page: Path) -> str:
    """A page's name from the root."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[tuple[str, str]]:
    """Fenced blocks of a page, each with its language."""
    return [(m[1], m[2]) for m in FENCE.finditer(page.read_text("utf-8"))]


@pytest.mark.parametrize("page", [p for p in WRITTEN if "python" in dict(blocks(p))], ids=names)
def test_blocks_run_and_print_what_stands_below_them(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In order and in one namespace; a ``text`` block after a ``python`` block is its output."""
    if page.name == "README.md":
        pytest.skip("its lines train a network: test_the_readme_s_lines_run shortens that")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    found = blocks(page)
    for (language, code), (following, output) in zip(found, [*found[1:], ("", "")], strict=True):
        if language == "python":
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(code, str(page), "exec"), namespace)
            if following == "text":
                assert printed.getvalue().strip() == output.strip()


def test_the_readme_s_lines_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ten lines, with fewer steps and without the progress bar."""
    monkeypatch.chdir(tmp_path)
    lines = next(code for language, code in blocks(ROOT / "README.md") if language == "python")
    quick = lines.replace("latent_dim=5", "latent_dim=5, max_steps=20")
    quick = quick.replace(", progress=True", "").replace('reaching")', 'reaching", movements=40)')
    assert quick.count("max_steps=20") == quick.count("movements=40") == 1
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        exec(compile(quick, "README.md", "exec"), {})
    assert (tmp_path / "arm.zoo").is_dir()


@pytest.mark.parametrize("page", WRITTEN, ids=names)
def test_links_of_written_pages_lead_somewhere(page: Path, site: Path) -> None:
    """Files of the tree, or pages that are made."""
    for link in LINK.findall(page.read_text("utf-8")):
        check_link(page.parent, link, site)


@pytest.mark.parametrize("folder", ["models", "results"])
def test_links_of_made_pages_lead_somewhere(folder: str, site: Path) -> None:
    """As they stand in the site."""
    for page in (site / folder).glob("*.md"):
        for link in LINK.findall(page.read_text("utf-8")):
            check_link(DOCS / folder, link, site)


def check_link(home: Path, link: str, site: Path) -> None:
    """An address within the tree names a file, and an anchor a heading of it."""
    if re.match(r"https?:", link):
        return
    name, _, anchor = link.partition("#")
    target = (home / name).resolve()
    inside = target.relative_to(ROOT)
    if inside.parts[0] == "docs" and inside.parts[1] in MADE:
        if inside.parts[1] == "notebooks":
            script = ROOT / "notebooks" / f"{inside.stem}.py"
            assert inside.stem == "index" or script.is_file(), link
            return
        target = site / Path(*inside.parts[1:])
    assert target.is_file(), f"{home}: {link}"
    if anchor:
        headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
        assert anchor in {re.sub(r"[^\w]+", "-", h.lower()).strip("-") for h in headings}, link


def test_every_entry_has_a_page_with_its_card(site: Path) -> None:
    """Summary, mathematics, settings and measured results; listed in the index."""
    index = (site / "models" / "index.md").read_text("utf-8")
    for entry in CATALOGUE:
        page = (site / "models" / f"{entry.name}.md").read_text("utf-8")
        assert f"({entry.name}.md)" in index
        assert entry.summary in page and f"# {entry.name}\n" in page
        found = zoo.card(entry.name)
        assert all(f"| `{setting}` |" in page for setting in found.settings)
        assert all(str(result["command"]) in page for result in found.results)


def test_every_public_name_is_in_the_reference() -> None:
    """By its directive, and every argument in a table of the same page."""
    pages = {p: p.read_text("utf-8") for p in DOCS.glob("reference/*.md")}
    for name in zoo.__all__:
        if name == "__version__":
            continue
        home = [text for text in pages.values() if f"\n::: zoo.{name}\n" in text]
        assert len(home) == 1, name
        thing = getattr(zoo, name)
        for argument in arguments(thing):
            assert f"`{argument}`" in home[0], f"zoo.{name}: {argument}"


def arguments(thing: type | object) -> set[str]:
    """Parameters of a function, or of all that a class's public methods take."""
    if not inspect.isclass(thing):
        return set(inspect.signature(thing).parameters)  # type: ignore[arg-type]
    methods = (m for n, m in inspect.getmembers(thing, callable) if not n.startswith("_"))
    return {a for m in methods for a in inspect.signature(m).parameters} - BUILT_IN


def test_directives_name_what_exists() -> None:
    """A module, or a name of one."""
    for page in DOCS.glob("reference/*.md"):
        for path in re.findall(r"^::: ([\w.]+)$", page.read_text("utf-8"), re.MULTILINE):
            module, _, name = path.rpartition(".")
            found = getattr(__import__(module, fromlist=[name]), name)
            assert inspect.getdoc(found), path


def test_tables_have_the_figures_that_are_stored(site: Path) -> None:
    """A row for every model of the leaderboard; a link for every entry that forecasts."""
    stored = json.loads((ROOT / "results" / "leaderboard_walk-setup-2.json").read_text("utf-8"))
    bands = (site / "tables" / "bands_walk.md").read_text("utf-8")
    assert all(f"| {row[0]} |" in bands for row in stored["rows"])
    costs = (site / "tables" / "costs.md").read_text("utf-8")
    assert all(f"models/{n}.md" in costs for n in CATALOGUE.names(can="forecast"))


def test_docstrings_become_markdown() -> None:
    """Roles are names, examples are code, formulas keep their signs."""
    pytest.importorskip("griffe")
    with from_docs("roles") as roles:
        text = roles.markdown("Of :class:`~zoo.run.Run`, a * b_c.\n\n>>> 1 + 1\n2")  # type: ignore[attr-defined]
    assert text == "Of ``Run``, a \\* b\\_c.\n\n```pycon\n>>> 1 + 1\n2\n```"


def test_formulas_of_notebooks_become_mathml() -> None:
    """Inline and displayed, with their number."""
    pytest.importorskip("latex2mathml")
    with from_docs("executed") as executed:
        text = executed.formulas(
            "so $a^2$ and\n$$\\beta = \\frac{\\alpha}{4} \\tag{53}$$\n$\\bigl\\| a \\bigr\\|$"
        )  # type: ignore[attr-defined]
    assert text.count("<math") == 3 and "(53)" in text
    assert not set("$\\") & set(text)
