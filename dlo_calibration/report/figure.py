# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Common parts of all drawings: colours, settings, legends, PNG files, and the panels of the page."""

from __future__ import annotations

import base64
from contextlib import contextmanager
from dataclasses import dataclass
import io
from pathlib import Path
import textwrap
import threading
from typing import Any, Callable, Iterator, Sequence, TYPE_CHECKING

from dlo_calibration.writing import whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

#: The palette of Okabe and Ito, which colour-blind people can distinguish (Color Universal Design, 2008).
BLUE, GREEN, PURPLE, SKY, YELLOW = '#0072b2', '#009e73', '#cc79a7', '#56b4e9', '#e69f00'
OBSERVED, SIMULATED, BEFORE, FAINT = 'black', '#d55e00', '0.72', '0.45'
OBSTACLE, EDGE = '#d9d9e0', '#8c8c99'  # of obstacles of a scene
BAND = '#f7d9c4'  # a light tint of SIMULATED
WIDTH, HEIGHT = 4.8, 3.5  # in, of a panel of the page: it stays readable on a phone
MOST_TICKS = 5  # intervals along a panel: of more, long numbers would touch each other
BAR_ROOM = 0.8  # in, for a colour bar beside the axes
#: Matplotlib's settings belong to the process, and its fonts are not thread-safe.
_LOCK = threading.Lock()
SETTINGS: Any = {'svg.hashsalt': 'dlo_calibration', 'svg.fonttype': 'none', 'axes.spines.top': False,
                 'axes.spines.right': False, 'axes.titley': 1.0, 'axes.labelpad': 7.0,
                 'axes.formatter.useoffset': False, 'axes.axisbelow': True}


@dataclass(frozen=True)
class Panel:
    """
    A drawing of the page.

    :param source: an SVG image in a data URI.
    :param words: what it shows, for those who cannot see it.
    """

    source: str
    words: str


def panel(draw: Callable[[Axes], None], words: str, legend: bool = True) -> Panel:
    """Draw a panel for the page, with the legend below the axes; `words` describe it."""
    left, right, top, bottom = 0.82, 0.12, 0.3, 0.55  # in, margins around the axes
    with settings():
        figure = blank_figure(WIDTH, HEIGHT, layout=None)
        axes = figure.add_axes((0, 0, 1, 1))
        draw(axes)
        axes.locator_params(axis='x', nbins=MOST_TICKS)
        handles, labels = axes.get_legend_handles_labels()
        labels = [textwrap.fill(label, 64) for label in labels]
        lines = sum(1 + label.count('\n') for label in labels) if legend else 0
        height = HEIGHT + 0.17 * (lines + 0.5 * (lines > 0))
        figure.set_size_inches(WIDTH, height)
        bars = figure.axes[1:]
        for part, x, width in ((axes, left, WIDTH - left - right - BAR_ROOM * len(bars)),
                              *((bar, WIDTH - BAR_ROOM + 0.1, 0.15) for bar in bars)):
            part.set_position((x / WIDTH, (height - HEIGHT + bottom) / height, width / WIDTH,
                              (HEIGHT - top - bottom) / height))
        if lines:
            figure.legend(handles, labels, loc='lower left', bbox_to_anchor=(0.02, 0), frameon=False,
                          fontsize=9, labelspacing=0.35)
        reach = axes.yaxis.get_tightbbox(figure.canvas.get_renderer())  # type: ignore[attr-defined]
        if reach is not None and reach.x0 < 0.03 * figure.dpi:  # wide numbers push the label out
            box, more = axes.get_position(), 0.03 / WIDTH - reach.x0 / (WIDTH * figure.dpi)
            axes.set_position((box.x0 + more, box.y0, box.width - more, box.height))
        octets = io.BytesIO()
        figure.savefig(octets, format='svg', metadata={'Date': None})
    return Panel(f'data:image/svg+xml;base64,{base64.b64encode(octets.getvalue()).decode()}', words)


@contextmanager
def settings() -> Iterator[None]:
    """Apply the common settings; only one drawing is made at a time."""
    from matplotlib import rc_context

    with _LOCK, rc_context(SETTINGS):
        yield


def blank_figure(width: float, height: float, layout: Any = 'constrained') -> Figure:
    """Return an empty figure [in]; without pyplot, it opens no window and is freed after use."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def write_figure(figure: Figure, path: str | Path) -> None:
    """
    Write a figure as a PNG.

    :raises InputError: if the file cannot be written.
    """
    with whole(Path(path)) as new:
        figure.savefig(new, format='png', dpi=110)


def add_legend(figure: FigureBase, axes: Sequence[Axes], columns: int = 4) -> None:
    """Add a legend below the figure for all `axes`, with each label once."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Patch

    shown: dict[str, Any] = {}
    for subplot in axes:
        for handle, label in zip(*subplot.get_legend_handles_labels(), strict=True):
            if isinstance(handle, PolyCollection):  # Matplotlib 3.6 takes none of a subfigure
                area: Any = handle  # its stubs do not say that it has a list of colours
                handle = Patch(facecolor=area.get_facecolor()[0], edgecolor=area.get_edgecolor()[0])
            shown.setdefault(label, handle)
    legend_outside(figure, 'lower center', handles=list(shown.values()), labels=list(shown),
                   ncols=min(columns, len(shown)))


def legend_outside(figure: FigureBase, place: str, **rest: Any) -> None:
    """Put a legend beside the axes; `rest` is of `Figure.legend`."""
    from matplotlib.figure import Figure

    add: Any = figure.legend  # its overloads do not know what is passed on
    try:
        add(loc=f'outside {place}', frameon=False, **rest)
    except ValueError:  # Matplotlib 3.6, which Ubuntu 24.04 has, leaves no room for it
        legend = add(loc=place, frameon=False, **rest)
        if isinstance(figure, Figure):  # a subfigure has no layout of its own
            layout: Any = figure.get_layout_engine()
            box = legend.get_window_extent().transformed(figure.transFigure.inverted())
            layout.set(rect=(0, box.y1, 1, 1 - box.y1) if place.startswith('lower') else (0, 0, 1, box.y0))


def as_text(name: str) -> str:
    """Return a name that Matplotlib shows literally: neither as a formula nor as a hidden label."""
    shown = name.replace('$', r'\$')
    return f' {shown}' if shown.startswith('_') else shown
