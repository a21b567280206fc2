# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The page: a result as one HTML file; page.html is its template."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from itertools import combinations
from pathlib import Path
import platform
import shlex
from types import MappingProxyType
from typing import Any, Mapping, Sequence, TYPE_CHECKING

from dlo_calibration.calibration.engines import obstacles_of
from dlo_calibration.calibration.options import Options, recordable
from dlo_calibration.calibration.result import CalibrationResult, plain
from dlo_calibration.errors import printable
from dlo_calibration.inference.slices import Slices
from dlo_calibration.inference.uncertainty import IDENTIFIABLE, NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.parameters import exact, measured, number
from dlo_calibration.model.score import MEAN_DISTANCE, PointErrors, residuals, SIMILAR, VERY_SIMILAR
from dlo_calibration.report.bending_drawing import moment_panels, rest_shape_panels
from dlo_calibration.report.drawing import Drawn, trial_panels
from dlo_calibration.report.landscape import convergence_panel, line_panels, plane_panels
from dlo_calibration.report.sentences import (
    fit_facts,
    lower_score,
    parameter_rows,
    sentences,
)
from dlo_calibration.simulation.scene import Obstacle

if TYPE_CHECKING:
    from jinja2 import Template

    from dlo_calibration.report.figure import Panel

MOST_TRIALS = 12  # are drawn, so that the page stays small
MOST_CORRELATIONS = 12  # parameters of a table of all; of more, as many pairs are listed


@dataclass(frozen=True)
class Origin:
    """
    The input of a calibration, with which it can be repeated.

    :param session: name of the session or file with the trials.
    :param command: the command that gives the same result again.
    :param options: of the calibration.
    :param digests: SHA-256 of each input file, by name.
    :param warnings: about the session.
    """

    session: str
    command: str
    options: Options
    digests: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()


def repeating_command(session: str, options: Options, selection: Sequence[str] = ()) -> str:
    """Return the command that calibrates on a session with these options, and flags that select trials."""
    changed = recordable(_changed(options))
    return shlex.join(['dlo-calibration', 'fit', session, *selection,
                       *(word for name, value in changed.items() for word in as_flags(name, value))])


def page_of(result: CalibrationResult, origin: Origin, slices: Slices | None = None,
            films: Mapping[int, Panel] = MappingProxyType({})) -> str:
    """
    Return the page, which needs no other file and no network.

    :param slices: through the best parameter set; None: the page has none.
    :param films: of trials, by index; see `before_after`.
    :raises InputError: if the scene can no longer be read.
    """
    values = plain(result)
    return _template().render(
        values=values, result=result, origin=origin, slices=slices, films=films, sentences=sentences(result),
        rows=parameter_rows(values['parameters'], result.space),
        correlated=most_correlated(values['correlations']),
        marks={IDENTIFIABLE: 'good', WEAK: 'weak', NOT_IDENTIFIABLE: 'bad', '': ''},  # classes of the style
        similar=SIMILAR, very_similar=VERY_SIMILAR, errors=_errors(result, values), facts=fit_facts(values),
        rest_shapes=rest_shape_panels(result), moments=moment_panels(result),
        convergence=convergence_panel(result), lower_score=lower_score(result),
        **_trials(result, obstacles_of(origin.options)),
        lines=[] if slices is None else line_panels(result, slices.lines),
        planes=[] if slices is None else [
            (plane.names, plane_panels(result, plane)) for plane in slices.planes],
        versions={name: _version(name) for name in
                  ('dlo_calibration', 'numpy', 'scipy', 'pybullet')},
        system=f'{platform.python_version()}, {platform.system()} {platform.machine()}',
        changed=_changed(origin.options), defaults=Options().flat(), options=origin.options.flat(),
        declarations=list(Options.declarations()))


@cache
def _template() -> Template:
    """Return the template, which takes a tenth of a second to compile."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined,
                              autoescape=True, trim_blocks=True, lstrip_blocks=True,
                              keep_trailing_newline=True,
                              finalize=lambda value: printable(value) if type(value) is str else value)
    environment.filters.update(number=number, exact=exact, squared=lambda text: text.replace('m^2', 'm²'))
    environment.globals.update(measured=measured)
    return environment.get_template('page.html')


def most_correlated(correlations: Mapping[str, Mapping[str, float]] | None) -> list[tuple[str, str, float]]:
    """Return the pairs of parameters with the largest correlations if there are too many for a table."""
    if correlations is None or len(correlations) <= MOST_CORRELATIONS:
        return []
    pairs = [(first, second, correlations[first][second]) for first, second in combinations(correlations, 2)]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))[:MOST_CORRELATIONS]


def _errors(result: CalibrationResult, values: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the mean distances to compare [m], by their descriptions; None for an unknown one."""
    noise = values['noise_m']
    return {
        'the parameters above': values['mean_error_m'],
        'a trial that is left out of the fit, predicted from the others': values['cross_validated_error_m'],
        'the default parameters': values['default_error_m'],
        'the noise of the measured points alone': None if noise is None else noise * MEAN_DISTANCE,
        'the uncertainty of the parameters alone (one standard deviation of the simulated points)':
            None if result.band is None else float(result.band.mean())}


def drawn_trials(result: CalibrationResult) -> list[int]:
    """Return the indices of the trials that the page draws: those with the largest errors."""
    errors = [PointErrors.of(residuals(trial, chains)).mean
              for trial, chains in zip(result.trials, result.chains, strict=True)]
    return sorted(sorted(range(len(errors)), key=lambda k: -errors[k])[:MOST_TRIALS])


def _trials(result: CalibrationResult, obstacles: Sequence[Obstacle]) -> dict[str, Any]:
    """Return a table row for each trial, and by index the drawings of those with the largest errors."""
    errors = [PointErrors.of(residuals(trial, chains))
              for trial, chains in zip(result.trials, result.chains, strict=True)]
    return {'trials': list(zip(result.trials, result.best.scores, errors, strict=True)),
            'drawn': {k: trial_panels(Drawn.of(result, k, obstacles)) for k in drawn_trials(result)}}


def _changed(options: Options) -> dict[str, Any]:
    """Return the options that differ from the defaults."""
    defaults = Options().flat()
    return {name: value for name, value in options.flat().items() if value != defaults[name]}


def as_flags(name: str, value: Any) -> list[str]:
    """Return the command-line arguments that set an option to a value."""
    flag = f'--{name.replace("_", "-")}'
    if isinstance(value, bool):
        return [flag if value else f'--no-{flag[2:]}']
    return [flag, ','.join(value) if isinstance(value, list) else str(value)]


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return 'not installed'
