"""Notebooks as pages: executed unless the same script was, by the same code, and then as Markdown.

An executed notebook is kept under ``build/notebooks`` with a key of all that made it: the script
and the code of every module of the package. The page says when it was executed and by which commit.
"""

from __future__ import annotations

import base64
import datetime
import hashlib
import json
import pkgutil
import re
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from latex2mathml.converter import convert
from nbclient import NotebookClient

import zoo.catalogue
from zoo.inference.resume.codehash import hashes
from zoo.studies.result import commit

__all__ = ["executed", "page"]

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "build" / "notebooks"
TIMEOUT = 1800
SOURCE = (
    "*Not executed for this build: code without its output. `make docs` without "
    "`NOTEBOOKS=source` executes it.*"
)


def executed(script: Path) -> Any:
    """The notebook of a script with its outputs: the one kept, or executed now."""
    kept, key = KEPT / f"{script.stem}.ipynb", _key(script)
    if kept.is_file():
        found = nbformat.read(kept, as_version=4)
        if found.metadata.get("movezoo", {}).get("key") == key:
            return found
    notebook = jupytext.read(script)
    print(f"{script.name}: executing, which takes minutes")
    client = NotebookClient(notebook, timeout=TIMEOUT, resources={"metadata": {"path": ROOT}})
    client.create_kernel_manager().transport = "ipc"
    client.execute()
    today = datetime.date.today().isoformat()
    notebook.metadata["movezoo"] = {"key": key, "date": today, "commit": commit()}
    KEPT.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, kept)
    return notebook


def page(script: Path, home: Path, *, execute: bool) -> str:
    """The notebook as Markdown; its pictures and moving parts are files in ``home``."""
    notebook = executed(script) if execute else jupytext.read(script)
    parts = [
        part
        for number, cell in enumerate(notebook.cells)
        if cell.source.strip()
        for part in _cell(cell, home, f"{script.stem}-{number}")
    ]
    title, rest = parts[0].split("\n", 1) if "\n" in parts[0] else (parts[0], "")
    return "\n\n".join([title, _origin(notebook, script), rest.strip(), *parts[1:]]) + "\n"


def _key(script: Path) -> str:
    """Hash of the script, the catalogue and the code of every module of the package."""
    modules = sorted(m.name for m in pkgutil.walk_packages(zoo.__path__, "zoo."))
    content = hashlib.sha256(json.dumps(hashes(m for m in modules if "__" not in m)).encode())
    for file in (script, Path(zoo.catalogue.__file__)):
        content.update(file.read_bytes())
    return content.hexdigest()


def _origin(notebook: Any, script: Path) -> str:
    made = notebook.metadata.get("movezoo")
    name = f"Notebook `notebooks/{script.name}`"
    if made is None:
        return f"{name}. {SOURCE}"
    return f"{name}, executed {made['date']}, commit `{made['commit'] or 'unknown'}`."


def _cell(cell: Any, home: Path, name: str) -> list[str]:
    if cell.cell_type != "code":
        return [formulas(cell.source)]
    shown = [f"```python\n{cell.source}\n```"]
    for number, output in enumerate(cell.get("outputs", [])):
        shown.append(_output(output, home, f"{name}-{number}"))
    return [part for part in shown if part]


def _output(output: Any, home: Path, name: str) -> str:
    """A picture, a page, a table or text; what only a notebook can show is left out."""
    if output.output_type == "stream":
        return _text(
            re.sub(r"^/\S+/ipykernel_\d+/\d+\.py:", "line ", output.text, flags=re.MULTILINE)
        )
    data = output.get("data", {})
    if "image/png" in data:
        (home / f"{name}.png").write_bytes(base64.b64decode(data["image/png"]))
        return f"![output of the cell above]({name}.png)"
    if "text/markdown" in data:
        return formulas(data["text/markdown"])
    if "text/html" in data:
        return _html(data["text/html"], home, name)
    return _text(data.get("text/plain", ""))


def _html(text: str, home: Path, name: str) -> str:
    """A table in the page; a page of its own in a frame."""
    if "<script" not in text and "<iframe" not in text:
        return f'<div class="output">{" ".join(text.split())}</div>'
    (home / f"{name}.html").write_text(text, encoding="utf-8")
    return f'<iframe class="output" title="player" src="{name}.html"></iframe>'


def _text(text: str) -> str:
    return f"```text\n{text.rstrip()}\n```" if text.strip() else ""


def formulas(text: str) -> str:
    """Markdown with its formulas as MathML, which browsers draw without a library.

    >>> formulas("with $a^2$").count("<msup>")
    1
    """
    text = re.sub(r"\$\$(.+?)\$\$", lambda m: _math(m[1], "block"), text, flags=re.DOTALL)
    return re.sub(r"(?<![\\$\w])\$([^$\n]+)\$(?!\w)", lambda m: _math(m[1], "inline"), text)


def _math(formula: str, display: str) -> str:
    """One formula; its number ``\\tag{…}`` stands beside it."""
    tag = re.search(r"\\tag\{([^}]*)\}", formula)
    bare = re.sub(r"\\tag\{[^}]*\}", "", formula).strip().rstrip(",")
    found = convert(bare, display=display)
    for sized, plain in ((r"\{", "{"), (r"\}", "}"), (r"\|", "‖")):
        found = found.replace(f">{sized}<", f">{plain}<")
    if display == "inline":
        return f"<span>{found}</span>"
    number = f'<span class="number">({tag[1]})</span>' if tag else ""
    return f'\n\n<div class="formula">{found}{number}</div>\n\n'
