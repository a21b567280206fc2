# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: what the node does, from a recorded session."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass
import json
import math
from pathlib import Path
import shutil
import sys
import time
from typing import Any, Callable, Mapping, NoReturn, Sequence, TextIO

from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Declaration, declarations, Options
from dlo_calibration.calibration.result import CalibrationResult, simulated_chains
from dlo_calibration.calibration.stages import confirmed, sliced
from dlo_calibration.cli import experiment
from dlo_calibration.errors import DloCalibrationError, InputError, SimulationError
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.experiment import tables
from dlo_calibration.experiment.study import Observed
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.request import read_request, request_trials
from dlo_calibration.files.result import Description, read_result, write_result
from dlo_calibration.files.session import read_session, Session, session_trials, trial_records
from dlo_calibration.inference.confirmation import Confirmation
from dlo_calibration.model.trial import Trial
from dlo_calibration.signals import StopFlag

PROGRAM = 'dlo-calibration'
INTERRUPTED = 130  # exit code of a program that Ctrl-C ended, by the shells' convention
#: Options that say what was observed, not how it is simulated.
OF_THE_SESSION = ('table', 'table_height', 'scene', 'grip_tolerance', 'length_tolerance', 'release')
RESULT, SESSION, REPORT, EVALUATIONS = 'result.xml', 'session.mcap', 'report.html', 'evaluations.csv'
REQUEST = 'request.xml'


def main(args: Sequence[str] | None = None, make_simulator: SimulatorFactory = make_chosen_simulator) -> int:
    """
    Do what a command line says.

    :param args: without the program's name; None: that of the process.
    :returns: exit code: 0; 2 for what cannot be used, after one line on stderr; 130 where
        Ctrl-C came before there was anything to report, or before an experiment was complete.
    """
    try:
        chosen = _parser().parse_args(args)
        code: int = chosen.verb(chosen, make_simulator)
        return code
    except DloCalibrationError as error:
        sys.stderr.write(f'{PROGRAM}: {" ".join(str(error).split())}\n')
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f'{PROGRAM}: interrupted\n')
        return INTERRUPTED
    except BrokenPipeError:  # the reader of a pipe has seen enough
        sys.stderr.close()
        return 0


class _Parser(argparse.ArgumentParser):
    """A parser whose errors take one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'{self.prog}: {" ".join(message.split())}; see {self.prog} --help\n')


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=PROGRAM, allow_abbrev=False, description=(
        'Find the physical parameters of a rope, cable, wire or hose from recorded manipulations.'))
    verbs = parser.add_subparsers(required=True, metavar='VERB')

    def verb(name: str, act: Callable[..., int], text: str) -> argparse.ArgumentParser:
        added = verbs.add_parser(name, help=text, description=text, allow_abbrev=False)
        added.set_defaults(verb=act)
        return added

    fit = verb('fit', _fit, 'find the parameter set that explains a session')
    validate = verb('validate', _validate, 'simulate a session with the parameters of a result; fit nothing')
    validate.add_argument('result', metavar='RESULT.xml', type=Path)
    info = verb('info', _info, 'say what is in a session')
    plot = verb('plot', _plot, 'draw a picture of each trial: measured, and simulated with a result')
    repeated = verb('experiment', _experiment,
                    "repeat the paper's experiment: how consistent found parameters are, and how valid")
    experiment.add_arguments(repeated)
    _add_options(repeated, without=experiment.NOT_AN_OPTION)
    for added in (fit, validate, plot, info):
        added.add_argument('session', metavar='SESSION', type=Path,
                           help='an MCAP file, the folder of a rosbag2 recording, or an XML request')
        added.add_argument('--namespace', help='of the topics, where the session holds several')
        added.add_argument('--json', action='store_true', help='print one JSON document')
        _add_options(added)
    fit.add_argument('--output', metavar='DIR', type=Path,
                     help=f'write {RESULT}, {SESSION}, {REPORT} and {EVALUATIONS} there')
    plot.add_argument('result', metavar='RESULT.xml', type=Path, nargs='?',
                      help='simulate with its parameters; without it, only what was measured is drawn')
    plot.add_argument('--output', metavar='DIR', type=Path, default=Path(),
                      help='write trial_1.png, ... there; default: the current folder')
    plot.add_argument('--animation', action='store_true',
                      help='also write trial_1.gif, ...: how the simulated DLO moves')
    return parser


def _add_options(parser: argparse.ArgumentParser, without: Sequence[str] = ()) -> None:
    """Add a flag for every option; what is not given is absent from the parsed ones."""
    group = parser.add_argument_group('options of the calibrator (default: as the session was recorded)')
    for declaration in (one for one in declarations() if one.name not in without):
        names = dict.fromkeys((f'--{declaration.name.replace("_", "-")}', f'--{declaration.name}'))
        group.add_argument(*names, dest=f'option_{declaration.name}', default=argparse.SUPPRESS,
                           **_flag(declaration))


def _flag(declaration: Declaration) -> dict[str, Any]:
    default = ' '.join(declaration.default) if isinstance(declaration.default, tuple) else declaration.default
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    text = f'{declaration.description}{unit}; default {default}'.replace('%', '%%')
    kind = type(declaration.default)
    if kind is bool:
        return {'action': argparse.BooleanOptionalAction, 'help': text}
    if kind is tuple:
        return {'nargs': '+', 'metavar': 'NAME', 'help': f'{text} (several words, or one with commas)'}
    return {'type': kind, 'metavar': kind.__name__.upper() if not declaration.choices else
            '|'.join(declaration.choices), 'help': text}


def _given(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return the options that were given as flags."""
    prefix = 'option_'
    given = {name[len(prefix):]: value for name, value in vars(chosen).items() if name.startswith(prefix)}
    return {name: [word for text in value for word in text.split(',') if word] if isinstance(value, list)
            else value for name, value in given.items()}


@dataclass(frozen=True)
class _Input:
    """A session with the options to use on it, and the trials in it."""

    session: Session
    options: Options
    trials: tuple[Trial, ...]
    refusals: tuple[str, ...]


def _read(chosen: argparse.Namespace, note: Callable[[str], None],
          of_result: Mapping[str, Any] | None = None) -> _Input:
    """
    Read the session with the options recorded in it, and flags before those.

    :param of_result: options of a result; of the recorded ones, only those in
        `OF_THE_SESSION` then count.
    """
    path = chosen.session
    request = read_request(path) if _is_request(path) else None
    session = read_session(path, chosen.namespace) if request is None else \
        Session(path, (), (), dict(request.options), ())
    recorded = session.recorded or {}
    if of_result:
        observed = {name: value for name, value in recorded.items() if name in OF_THE_SESSION}
        recorded = {**of_result, **observed}
    given = _given(chosen)
    options = Options.of({**Options().flat(), **recorded, **given})
    for name in given:
        value = options.flat()[name]
        if value != recorded.get(name, value):
            note(f'{name}: {_shown(value)} instead of {_shown(recorded[name])}')
    trials, refusals = session_trials(session, options) if request is None else \
        request_trials(request, options)
    for text in (*session.problems, *refusals):
        note(text)
    return _Input(session, options, trials, refusals)


def _is_request(path: Path) -> bool:
    return path.suffix.lower() == '.xml'


def _files(source: Path) -> tuple[str, ...]:
    """Name the files that `fit` writes."""
    return RESULT, *((REQUEST,) if _is_request(source) else ()), SESSION, REPORT, EVALUATIONS


def _shown(value: Any) -> str:
    return ' '.join(value) if isinstance(value, list) else str(value)


def _some(found: _Input) -> tuple[Trial, ...]:
    if not found.trials:
        raise InputError(f'session {found.session.path}', 'no complete trial',
                         'an initial_chain, an action and a goal_chain, in the order of their stamps',
                         f'see what is in it with {PROGRAM} info')
    return found.trials


def _note(text: str) -> None:
    sys.stderr.write(f'{text}\n')


def _fit(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    from dlo_calibration.report.terminal import SearchBar

    found = _read(chosen, _note)
    trials = _some(found)
    folder = chosen.output
    if folder is None and 'output_directory' in _given(chosen):
        folder = Path(found.options.output_directory)
    if folder is not None:
        _make_folder(folder, _files(chosen.session))
    told: list[str] = []

    def tell(text: str) -> None:
        if text not in told:
            _note(f'warning: {text}')
            told.append(text)

    with StopFlag() as stop:
        with SearchBar(found.options.evaluations, sys.stderr, shown=not chosen.json) as bar:
            try:
                result = calibrate(
                    trials, found.options, on_evaluation=bar.take, on_notice=tell, should_stop=stop,
                    make_simulator=make_simulator)
            except SimulationError:
                if not stop():
                    raise
                raise KeyboardInterrupt from None
        try:
            if folder is not None:
                _write(folder, chosen.session, found, result, make_simulator, stop)
                _note(f'{", ".join(_files(chosen.session))} are in {folder}')
        finally:  # a disk that is full by now must not lose what was found
            _print_result(result, chosen.json, told)
    return 0


def _validate(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    file = read_result(chosen.result)
    found = _read(chosen, _note, file.options)
    result = validated(file, _some(found), found.options, make_simulator)
    result = confirmed(result, found.options, make_simulator)
    _print_result(result, chosen.json)
    return 0


def _plot(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    from dlo_calibration.report.plot import write_animations, write_pictures

    if chosen.animation and chosen.result is None:
        raise InputError('--animation', 'no RESULT.xml', 'parameters to simulate with',
                         f'name a result: {PROGRAM} plot SESSION RESULT.xml --animation')
    file = None if chosen.result is None else read_result(chosen.result)
    found = _read(chosen, _note, None if file is None else file.options)
    trials = _some(found)
    animations: list[Path] = []
    if file is None:
        pictures = write_pictures(trials, None, chosen.output, _note)
    else:
        result = validated(file, trials, found.options, make_simulator)
        pictures = write_pictures(trials, result.chains, chosen.output, _note)
        if chosen.animation:
            simulator = make_simulator(found.options)
            physical = file.space.physical(file.values, result.length)
            try:
                animations = write_animations(trials, simulator, physical, chosen.output, _note)
            finally:
                simulator.close()
    if chosen.json:
        _print_json({'pictures': [str(path) for path in pictures],
                     'animations': [str(path) for path in animations]}, sys.stdout)
    return 0


def validated(file: Description, trials: Sequence[Trial], options: Options,
              make_simulator: SimulatorFactory = make_chosen_simulator) -> CalibrationResult:
    """
    Simulate trials with the parameters of a result; nothing is fitted.

    :returns: as of a calibration that tried this parameter set only, with the
        result's own parameters and intervals.
    :raises SimulationError: where a trial cannot be simulated.
    """
    simulator = make_simulator(options)
    begun = time.monotonic()
    try:
        evaluation = Evaluator(trials, file.space, simulator).evaluate(0, file.space.point(file.values))
    finally:
        simulator.close()
    if evaluation.failure:
        raise SimulationError(evaluation.failure)
    warnings = tuple(f'never came to rest: {name}; compared as it was at the limit'
                     for name in evaluation.unsettled)
    return CalibrationResult(
        space=file.space, parameters=file.parameters, best=evaluation, trials=tuple(trials),
        chains=simulated_chains(trials, evaluation), evaluations=(evaluation,),
        seconds=time.monotonic() - begun, search=file.search, engine=simulator.name,
        stop_reason='validation: nothing was fitted', seed=file.seed, warnings=warnings)


def document(result: CalibrationResult) -> dict[str, Any]:
    """Return what `fit` and `validate` print as JSON."""
    from dlo_calibration.report import sentences

    errors = result.errors
    return {
        'parameters': {
            name: {key: value for key, value in asdict(estimate).items() if key != 'name'}
            for name, estimate in result.parameters.items()},
        'score': result.best.score, 'scores': list(result.best.scores),
        'mean_error_m': errors.mean, 'rms_error_m': errors.rms, 'max_error_m': errors.max,
        'mean_abs_error_m': errors.mean_abs, 'error_percent_of_length': 100 * errors.mean / result.length,
        'trials': len(result.trials), 'evaluations': len(result.evaluations),
        'simulations': result.simulations, 'seconds': result.seconds, 'engine': result.engine,
        'search': result.search, 'seed': result.seed, 'stop_reason': result.stop_reason,
        'warnings': list(result.warnings), **sentences.values(result),
        'confirmation': None if result.confirmation is None else _confirmation(result.confirmation)}


def _confirmation(confirmation: Confirmation) -> dict[str, Any]:
    """Return what a second engine gave, with the keys of the whole document."""
    errors = confirmation.errors
    return {
        'engine': confirmation.engine, 'score': confirmation.score, 'scores': list(confirmation.scores),
        'mean_error_m': errors.mean, 'rms_error_m': errors.rms, 'max_error_m': errors.max,
        'mean_abs_error_m': errors.mean_abs, 'mean_distance_m': confirmation.mean_distance,
        'max_distance_m': confirmation.max_distance}


def _print_json(value: Mapping[str, Any], stream: TextIO) -> None:
    json.dump(_finite(value), stream, indent=2, allow_nan=False)
    stream.write('\n')
    stream.flush()


def _finite(value: Any) -> Any:
    """Return `value` with None in place of numbers that JSON does not know."""
    if isinstance(value, Mapping):
        return {str(key): _finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _print_result(result: CalibrationResult, as_json: bool, told: Sequence[str] = ()) -> None:
    from dlo_calibration.report import terminal

    for warning in result.warnings:
        if warning not in told:
            _note(f'warning: {warning}')
    found = document(result)
    if as_json:
        _print_json(found, sys.stdout)
        return
    terminal.print_result(result, found['parameters'], sys.stdout)


def _make_folder(folder: Path, names: Sequence[str]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            with (folder / name).open('ab'):
                pass
    except OSError as error:
        raise InputError(f'folder {folder}', str(error), 'a folder that can be written to',
                         'choose another one with --output') from error


def _write(folder: Path, source: Path, found: _Input, result: CalibrationResult,
           make_simulator: SimulatorFactory, should_stop: Callable[[], bool]) -> None:
    """Write the files of `fit`."""
    from dlo_calibration.report.page import (
        digests,
        Origin,
        repeating_command,
        write_evaluations,
        write_report,
    )

    write_result(folder / RESULT, result, found.options.flat())
    _write_session(folder / SESSION, source, found)
    if _is_request(source):
        _copy(source, folder / REQUEST)
    write_evaluations(folder / EVALUATIONS, result)
    repeated = REQUEST if _is_request(source) else SESSION
    origin = Origin(source.name, repeating_command(repeated, found.options), found.options,
                    digests([*_recorded(source), folder / repeated]),
                    [*found.session.problems, *found.refusals])
    slices = sliced(result, found.options, make_simulator, should_stop)
    write_report(folder / REPORT, result, origin, slices)


def _recorded(source: Path) -> list[Path]:
    """List the files that hold the messages of a session."""
    return [source] if source.is_file() else sorted(path for path in source.iterdir()
                                                    if path.suffix in ('.mcap', '.db3', '.zstd'))


def _write_session(path: Path, source: Path, found: _Input) -> None:
    """
    Copy a session into one MCAP file; one that is already such a file, byte by byte.

    Of a request, the messages are written that a robot would have sent.
    """
    files = [source] if source.is_file() else sorted(source.glob('*.mcap'))
    try:
        if len(files) == 1 and files[0].suffix == '.mcap':
            _copy(files[0], path)
            return
        records, options = found.session.records, found.session.recorded
        if _is_request(source):
            records, options = trial_records(found.trials), found.options.flat()
        writer = SessionWriter(path.with_name(f'{path.name}.new'), options)
        with writer:
            for record in records:
                writer.write(record.topic, record.type, record.data, record.log_time, flush=False)
        writer.file.replace(path)
        shutil.rmtree(writer.path)
    except OSError as error:
        raise InputError(f'file {path}', str(error), 'a place that can be written to',
                         'choose another one with --output') from error


def _copy(source: Path, target: Path) -> None:
    if not (target.exists() and target.samefile(source)):
        shutil.copyfile(source, target)


def _experiment(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    from dlo_calibration.report.page import as_flags

    given = _given(chosen)

    def observe(path: Path, of_result: Mapping[str, Any] | None = None) -> Observed:
        one = argparse.Namespace(**{**vars(chosen), 'session': path})
        found = _read(one, lambda text: _note(f'{path}: {text}'), of_result)
        return Observed(_some(found), found.options)

    flags = [flag for name, value in given.items() for flag in as_flags(name, value)]
    plan = experiment.planned(chosen, given, [PROGRAM, 'experiment'], flags, observe)
    with StopFlag() as stop:
        account = experiment.act(plan, chosen.output, make_simulator, stop, _note, sys.stderr)
    if account is None:
        raise KeyboardInterrupt
    if chosen.json:
        _print_json(tables.document(account), sys.stdout)
    else:
        sys.stdout.write(tables.markdown(account))
    return 0 if account.complete else INTERRUPTED


def _info(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    from dlo_calibration.report import terminal

    found = _read(chosen, lambda text: None)
    about = _about(found)
    if chosen.json:
        _print_json(about, sys.stdout)
    else:
        terminal.print_info(about, sys.stdout)
    return 0


def _about(found: _Input) -> dict[str, Any]:
    """Return what is in a session."""
    records = found.session.records
    counts: dict[str, int] = {}
    for record in records:
        counts[record.topic] = counts.get(record.topic, 0) + 1
    frames = sorted({message.header.frame_id for _, message in found.session.messages})
    duration = (records[-1].log_time - records[0].log_time) / 1e9 if records else 0.0
    return {
        'session': str(found.session.path), 'duration_s': duration, 'frames': frames,
        'messages': dict(sorted(counts.items())), 'options': found.session.recorded,
        'trials': [_about_trial(trial) for trial in found.trials],
        'refusals': list(found.refusals), 'problems': list(found.session.problems)}


def _about_trial(trial: Trial) -> dict[str, Any]:
    chains = [trial.initial, *(goal.chain for goal in trial.goals)]
    return {
        'name': trial.name, 'points': len(trial.initial), 'length_m': trial.initial.length,
        'hands': [{'name': hand.name, 'grips': list(hand.grips), 'waypoints': len(hand.times),
                   'start_s': hand.start, 'end_s': hand.end} for hand in trial.hands],
        'actions': len(trial.actions), 'goals': len(trial.goals),
        'stable_goals': sum(goal.stable for goal in trial.goals),
        'timed_goals': sum(not goal.stable for goal in trial.goals),
        'duration_s': max(trial.goals[-1].time, *(hand.end for hand in trial.hands)),
        'moving_start': trial.velocity is not None,
        'annotated_hands': any(chain.hands is not None for chain in chains),
        'annotated_features': int(sum(chain.features.sum() for chain in chains))}


if __name__ == '__main__':
    sys.exit(main())
