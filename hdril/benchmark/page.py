"""The report of a benchmark as files: Markdown, one self-contained HTML page, its figures and its numbers."""

from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hdril.benchmark.figures import FIGURES, figures
from hdril.benchmark.report import markdown
from hdril.benchmark.results import runs_of
from hdril.digest import SHORT, digest_json
from hdril.evaluation.checkpoint import read_json
from hdril.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#1c2733}"
    "table{border-collapse:collapse;margin:1rem 0;display:block;overflow-x:auto}"
    "td,th{border:1px solid #c8d2dc;padding:.25rem .6rem;text-align:left}th{background:#eef3f8}"
    "pre{background:#f4f6f8;padding:.8rem;overflow-x:auto;font-size:12px}svg{max-width:100%;height:auto}"
)
_COLOURS = 64
"""Of a PNG. A few lines and letters need no more, and it has a third of the bytes."""
_DIGITS = 6
"""Significant digits of a number in the JSON."""


def write_report(document: Path, results: Mapping[str, Any], gone: Iterable[str] = ()) -> list[Path]:
    """Write ``<document>.json``, ``.md`` and ``.html``, and each figure as ``<document>_<table>_<name>.png`` and ``.svg``.

    The page holds everything that it shows. Older figures of these tables and of those that are ``gone``, by title, are removed.
    Returns the files.
    """

    def beside(suffix: str) -> Path:
        return document.with_name(document.name + suffix)

    results = _short(results)  # what is read again makes the same page
    drawn = [figures(table) for table in results["tables"]]
    files: dict[Path, bytes] = {numbers_file(document): _one_a_line(results).encode()}
    names = []
    for table, found in zip(results["tables"], drawn, strict=True):
        names.append([f"{document.name}_{slug(table['title'])}_{name}" for name in found])
        for name, figure in zip(names[-1], found.values(), strict=True):
            for kind in ("png", "svg"):
                files[document.with_name(f"{name}.{kind}")] = _picture(figure, kind)
    files[beside(".md")] = markdown(results, [[f"{name}.png" for name in each] for each in names]).encode()
    pictures = {f"{name}.png": files[document.with_name(f"{name}.svg")].decode() for each in names for name in each}
    files[beside(".html")] = _page(files[beside(".md")].decode(), pictures).encode()
    for path, data in files.items():
        write_atomically(path, lambda file, data=data: file.write(data))
    for title, name, kind in product(
        (*gone, *(table["title"] for table in results["tables"])), FIGURES, ("png", "svg")
    ):
        path = document.with_name(f"{document.name}_{slug(title)}_{name}.{kind}")
        if path not in files:
            path.unlink(missing_ok=True)
    return list(files)


def numbers_file(document: Path) -> Path:
    """Where the numbers of a report are."""
    return document.with_name(document.name + ".json")


def write_numbers(document: Path, results: Mapping[str, Any]) -> None:
    """Write ``<document>.json`` alone: the tables are as they were."""
    write_atomically(numbers_file(document), lambda file: file.write(_one_a_line(results).encode()))


def read_numbers(document: Path) -> dict[str, Any]:
    """Results as they were written, numbers to six significant digits.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged.
    """
    results = read_json(numbers_file(document))
    steps = results.pop("steps", {})
    for run in runs_of(results):
        # Older reports have the whole in each run, and the oldest nothing.
        for kind, name in run.get("made_from", {}).items():
            if isinstance(name, str):
                if name not in steps:
                    raise ValueError(
                        f"{numbers_file(document)} is damaged: there is no step {name!r}, from which a run was made"
                    )
                run["made_from"][kind] = dict(steps[name])
    return results


def _one_a_line(results: Mapping[str, Any]) -> str:
    """JSON that is small, and of which a change of one table, or of one run of an unfinished one, changes few lines.

    Recordings and trainings, from which many runs were made, are listed once, in ``steps``.
    """
    dump = json.JSONEncoder(separators=(",", ":")).encode
    told = _short(results)
    steps: dict[str, Any] = {}
    for run in runs_of(told):
        for kind, step in run.get("made_from", {}).items():
            # Of all that is known of it: the same result may have been made on two machines.
            name = digest_json(step)[:SHORT]
            steps[name] = step
            run["made_from"][kind] = name
    lines = {
        "tables": _lines("[]", map(dump, told.pop("tables", []))),
        "runs": _lines("[]", map(dump, told.pop("runs", []))),
        "steps": _lines("{}", (f"{dump(name)}:{dump(steps[name])}" for name in sorted(steps))),
    }
    return f"{dump(told)[:-1]}{''.join(f',"{key}":{text}' for key, text in lines.items())}}}"


def _lines(brackets: str, members: Iterable[str]) -> str:
    """A list or an object with a line for each member."""
    inner = ",\n".join(members)
    return f"{brackets[0]}\n{inner}\n{brackets[1]}" if inner else brackets


def _short(value: Any) -> Any:
    """A copy whose numbers have few digits."""
    if isinstance(value, Mapping):
        return {key: _short(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_short(each) for each in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def slug(title: str) -> str:
    """A title as a part of file names."""
    return re.sub(r"\W+", "_", title.lower(), flags=re.ASCII).strip("_")


def _picture(figure: Figure, kind: str) -> bytes:
    """The same bytes for the same numbers: without the time of drawing, and with names of parts that do not change."""
    import matplotlib

    buffer = io.BytesIO()
    # Letters stay text: as outlines they are most of a page's bytes, and cannot be searched or read aloud.
    with matplotlib.rc_context(
        {"svg.hashsalt": "hdril", "svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans", "sans-serif"]}
    ):
        figure.savefig(buffer, format=kind, dpi=110, metadata={"Date": None} if kind == "svg" else {"Software": None})
    return _few_colours(buffer) if kind == "png" else _few_digits(buffer.getvalue().decode()).encode()


def _few_colours(picture: io.BytesIO) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    image = Image.open(picture).convert("RGB")
    # The median cut, which is the default, turns colours of a few pixels, as marks have them, into grey.
    image = image.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    image.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def _few_digits(picture: str) -> str:
    """An SVG without indents, and with hundredths of a point. Words keep their digits: they are outside of tags."""
    tags = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d\.\d\d)\d+", r"\1", tag[0]), picture)
    return re.sub(r"\n\s+", "\n", tags)


def _page(text: str, pictures: Mapping[str, str]) -> str:
    """Markdown as a page, with its pictures in place of the links to them."""
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark").enable("table").render(text)
    for number, (name, picture) in enumerate(pictures.items()):
        inline = picture[picture.index("<svg") :]
        # Names of parts are the same in every picture; in one page they must differ.
        inline = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>p{number}_", inline)
        body = re.sub(rf'<img src="{re.escape(name)}"[^>]*>', lambda _, inline=inline: inline, body)
    title = html.escape(text.splitlines()[0].lstrip("# "))
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style></head>'
        f"<body>{body}</body></html>\n"
    )
