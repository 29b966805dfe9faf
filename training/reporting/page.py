"""One self-contained HTML page: tables as text, panels inline; it asks nothing of any network."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from training.reporting.tables import COLUMNS, SIDES, TITLES, Line
from training.sweep.priors import PriorName

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1280px;margin:2rem auto;padding:0 1rem;color:#1c1f24;background:#fff}
h1{font-size:1.6rem}h2{margin-top:2.4rem;border-bottom:1px solid #ccd;padding-bottom:.2rem}h3{margin:1.4rem 0 .3rem}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:12.5px;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .5rem;border-bottom:1px solid #e3e5ea;text-align:right;white-space:nowrap}
th{background:#f4f5f8;font-weight:600}td.name,th.name{text-align:left}td.paper,th.paper{color:#6a4a00;background:#fdf7e8}
td.edge,th.edge{border-left:2px solid #c8ccd6}.note{color:#555b66;font-size:13px}
img{max-width:100%;height:auto;display:block}figure{margin:.8rem 0}figcaption{font-size:13px;color:#555b66}
pre{background:#f4f5f8;padding:.6rem .8rem;overflow-x:auto;font-size:12.5px}
"""


@dataclass(frozen=True)
class Panel:
    """A picture (PNG) with its words, or the reason why there is none."""

    title: str
    words: str
    png: bytes | None = None


@dataclass(frozen=True)
class Chapter:
    """What the page says on one cohort.

    Attributes:
        facts: sentences on data and method, plain text.
        paired: sentences on the differences with and without flow and ARD.
    """

    cohort: str
    facts: Sequence[str]
    lines: Sequence[Line]
    paired: Sequence[str]
    panels: Sequence[Panel]


def page(title: str, chapters: Sequence[Chapter], commands: Sequence[str]) -> str:
    """The whole document."""
    body = "".join(_chapter(chapter) for chapter in chapters)
    made = f"<pre>{escape(chr(10).join(commands))}</pre>" if commands else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body><h1>{escape(title)}</h1>"
        f"{_paragraph(INTRODUCTION)}{made}{body}</body></html>\n"
    )


INTRODUCTION = (
    "Mean ± population standard deviation over test shapes that were not trained on. ASD is the mean of both "
    "directions, HD95 and HD are the larger of both, by the surface-distance package. Dimensions are those "
    "that hold 95, 97 and 99 % of the base variance; R² and r compare, over generated shapes, the distance in "
    "z0 to the nearest training code with the distance between the two surfaces. Yellow columns are the "
    "MorphoFlow paper's figures for the same kind of bone: another data set, beside which nothing here is a "
    "comparison of methods. Those with * contradict other cells of the paper."
)


def _chapter(chapter: Chapter) -> str:
    facts = "".join(_paragraph(words, "note") for words in chapter.facts)
    paired = "".join(_paragraph(words) for words in chapter.paired)
    panels = "".join(_panel(panel) for panel in chapter.panels)
    return f"<h2>{escape(chapter.cohort)}</h2>{facts}{_table(chapter.lines)}{paired}{panels}"


def _table(lines: Sequence[Line]) -> str:
    paper = any(line.paper for line in lines)
    span = (2 if paper else 1) * len(COLUMNS)
    top = _row(
        _head("", "name") * 4
        + "".join(_head(words, "edge", span + 1) for _, words in SIDES)
        + _head("", "edge", 2 * (1 + paper))
    )
    names = "".join(_head(words, "name") for words in ("trained on", "measured in", "objective", "D"))
    side = _head("n", "edge") + "".join(_head(title) + (_head("paper", "paper") if paper else "") for title in TITLES)
    tail = "".join(
        _head(words, "edge" if not place else "") + (_head("paper", "paper") if paper else "")
        for place, words in enumerate(("95-97-99 %", "R² / r"))
    )
    rows = "".join(_line(line, paper=paper) for line in lines)
    head = f"<thead>{top}{_row(names + side * 2 + tail)}</thead>"
    return f'<div class="wide"><table>{head}<tbody>{rows}</tbody></table></div>'


def _line(line: Line, *, paper: bool) -> str:
    names = (line.trained, line.measured, line.objective, str(line.latent_size))
    cells = [_cell(words, "name") for words in names]
    for prior, _ in SIDES:
        cells.append(_cell(str(line.cases.get(prior, "")), "edge"))
        for place, name in enumerate(COLUMNS):
            ours = line.figures.get(prior, {}).get(name)
            cells.append(_cell("" if ours is None else _pair(ours, 3)))
            theirs = line.paper.get(prior)
            mark = "*" if theirs is not None and theirs.doubtful else ""
            cells += [_cell("" if theirs is None else _pair(theirs.figures[place], 2) + mark, "paper")] if paper else []
    full = line.paper.get(PriorName.FLOW_ARD)
    cells.append(_cell("-".join(map(str, line.active)), "edge"))
    cells += [_cell("" if full is None else "-".join(map(str, full.active or ())), "paper")] if paper else []
    cells.append(_cell(_correlation(line.correlation)))
    cells += [_cell("" if full is None else _correlation(full.correlation), "paper")] if paper else []
    return _row("".join(cells))


def _panel(panel: Panel) -> str:
    if panel.png is None:
        return f"<h3>{escape(panel.title)}</h3>{_paragraph(panel.words, 'note')}"
    source = base64.b64encode(panel.png).decode("ascii")
    picture = f'<img alt="{escape(panel.title)}" src="data:image/png;base64,{source}">'
    return f"<h3>{escape(panel.title)}</h3><figure>{picture}<figcaption>{escape(panel.words)}</figcaption></figure>"


def _correlation(values: tuple[float, float] | None) -> str:
    return "" if values is None else f"{values[0]:.2f} / {values[1]:.2f}"


def _pair(values: tuple[float, float], digits: int) -> str:
    return f"{values[0]:.{digits}f} ± {values[1]:.{digits}f}"


def _row(cells: str) -> str:
    return f"<tr>{cells}</tr>"


def _head(words: str, kind: str = "", span: int = 1) -> str:
    return f'<th class="{kind}" colspan="{span}">{escape(words)}</th>'


def _cell(words: str, kind: str = "") -> str:
    return f'<td class="{kind}">{escape(words)}</td>'


def _paragraph(words: str, kind: str = "") -> str:
    return f'<p class="{kind}">{escape(words)}</p>'
