# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Mutations of good messages and files, given to the reader, to the verbs, and to the live node."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import io
import json
from pathlib import Path
import random
import resource
import time
from typing import Iterator

from mcap.writer import CompressionType, Writer
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from tally import Tally
from toy_graph import ToyGraph
from toy_messages import SECOND, session_messages, toy_trials, write_session
from toy_simulator import new_toy, ToySimulator
from without_drawings import leave_out_drawings, leave_out_slices
from wrong_input import mutated, serialised

from dlo_calibration.calibration.options import FileOptions
from dlo_calibration.cli.main import main
from dlo_calibration.errors import InputError
from dlo_calibration.files.record import decode, encode, Record, typestore
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.files.request import Request, TrialRequest, write_request
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import bag_types, INPUT_TYPES, read

FULL = 200  # rounds, of about three seconds each
MESSAGES = 50  # mutated ones a round for the reader
FLOOD = 2000  # mutated ones for a node in another process, in the full form
TYPES = bag_types()
GOOD = session_messages(TYPES, 2)
OCTETS = [(kind, encode(message, INPUT_TYPES[kind])) for kind, message in GOOD]
QUICK = {'calibrate': ['flexibility', 'friction'], 'evaluations': 4, 'workers': 1}


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Try so many rounds, each at every door."""
    tally = Tally()
    files, result, request = good_files(folder)
    with quiet():
        for k in range(amount):
            dice = random.Random(f'{seed} {k}')
            for door in (mutated_messages, mutated_session, flipped_file, mutated_file, mutated_documents):
                begun = time.monotonic()
                try:
                    door(tally, dice, folder, files, result, request)
                except Exception as error:
                    tally.died += 1
                    print(f'round {k}, {door.__name__}: {error!r}', flush=True)
                tally.remember(silence=time.monotonic() - begun)
            if k % 20 == 0:
                live(tally, dice, folder / f'live_{k}')
    if amount >= FULL:
        node(tally, random.Random(seed), folder)
    tally.remember(peak=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
    return tally


@contextmanager
def quiet() -> Iterator[None]:
    """Leave the drawings of pages out."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_drawings(patch.setattr)
        leave_out_slices(patch.setattr)
        yield


# ---- what is mutated


def good_files(folder: Path) -> tuple[list[tuple[Path, int]], Path, Path]:
    """Write good sessions, each with how many messages one wrong bit may cost; a result, a request."""
    ours = write_session(folder / 'ours', GOOD, QUICK)
    files = [(next(ours.glob('*.mcap')), 1)]
    for compression in (CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE, None):
        path = folder / f'{compression}.mcap'
        with path.open('wb') as stream:
            writer = Writer(stream, chunk_size=800, compression=compression or CompressionType.NONE,
                            use_chunking=compression is not None)
            writer.start(profile='ros2')
            channels = {}
            for kind, name in INPUT_TYPES.items():
                definition = typestore().generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, 'ros2msg', definition)
                channels[kind] = writer.register_channel(f'/{kind}', 'cdr', schema)
            for k, (kind, octets) in enumerate(OCTETS):
                writer.add_message(channels[kind], (k + 1) * SECOND, octets, (k + 1) * SECOND)
            writer.finish()
        files.append((path, 1 if compression is None else 3))
    for plugin in StoragePlugin:
        with BagWriter(folder / plugin.name, version=9, storage_plugin=plugin) as writer:
            topics = {kind: writer.add_connection(f'/{kind}', name, typestore=typestore())
                      for kind, name in INPUT_TYPES.items()}
            for k, (kind, octets) in enumerate(OCTETS):
                writer.write(topics[kind], (k + 1) * SECOND, octets)
        files.append((next(path for path in (folder / plugin.name).iterdir() if path.suffix != '.yaml'),
                      len(GOOD)))  # one chunk, one page
    code, _, error = verb('fit', ours, '--json', '--output', folder / 'out')
    assert code == 0, error
    request = folder / 'request.xml'
    write_request(request, Request(tuple(map(TrialRequest.of, toy_trials(2))), FileOptions(QUICK)))
    return files, folder / 'out' / 'result.xml', request


def verb(*words: object) -> tuple[int, str, str]:
    """Return the exit code of a verb with the toy, and what it says."""
    out, error = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        code = main([str(word) for word in words], new_toy)
    return code, out.getvalue(), error.getvalue()


def judged(tally: Tally, *words: object) -> str | None:
    """Return the output of a verb; None where it refuses, which it must do in one line."""
    code, out, error = verb(*words)
    tally.tried += 1
    tally.refused += code == 2
    if code not in (0, 2) or 'Traceback' in error or code == 2 and not error.strip():
        tally.died += 1
        print(f'{words}: code {code}: {error[-500:]}', flush=True)
    if 'please report it' in error:
        tally.died += 1
        print(f'{words}: {error[-500:]}', flush=True)
    return out if code == 0 else None


# ---- the doors


def mutated_messages(tally: Tally, dice: random.Random, *_: object) -> None:
    """Read mutated messages."""
    for _ in range(MESSAGES):
        kind, octets = dice.choice(serialised('world'))
        tally.tried += 1
        try:
            read(kind, decode(Record(f'/{kind}', INPUT_TYPES[kind], mutated(octets, dice), 1)))
        except InputError as error:
            tally.refused += 1
            assert all((error.thing, error.came, error.expected, error.remedy))


def mutated_session(tally: Tally, dice: random.Random, folder: Path, files: object, result: Path,
                    *_: object) -> None:
    """Give a session with mutated messages before, between and after the good ones to the verbs."""
    messages = list(OCTETS)
    for _ in range(dice.randint(1, 6)):
        kind, octets = dice.choice(serialised('camera'))
        messages.insert(dice.randint(1, len(messages)), (kind, mutated(octets, dice)))
    path = folder / 'mutated.mcap'
    path.unlink(missing_ok=True)
    with SessionWriter(path, QUICK) as writer:
        for k, (kind, octets) in enumerate(messages):
            writer.write(f'/calibrator/{kind}', INPUT_TYPES[kind], octets, (k + 1) * SECOND,
                         flush=dice.random() < 0.5)
    kept = Counter(record.data for record in read_session(path).records)
    tally.lost += sum((Counter(octets for _, octets in OCTETS) - kept).values())
    about = judged(tally, 'info', path, '--json')
    # The frames differ, so that no mutation fits between the good messages, unless it hits the frame_id.
    if about is None or not json.loads(about)['trials']:
        tally.lost += 2
        print(f'the good trials are lost: {about}', flush=True)
    words = dice.choice((('fit', path), ('validate', result, path), ('plot', path)))
    judged(tally, *words, *(('--output', folder / 'plot.png') if words[0] == 'plot' else ('--json',)))


def flipped_file(tally: Tally, dice: random.Random, folder: Path, files: list[tuple[Path, int]],
                 *_: object) -> None:
    """Read files of which one bit is wrong."""
    for source, allowed in files:
        octets = bytearray(source.read_bytes())
        octets[dice.randrange(len(octets))] ^= 1 << dice.randint(0, 7)
        path = folder / f'flipped{source.suffix}'
        path.write_bytes(octets)
        tally.tried += 1
        try:
            session = read_session(path)
        except InputError:
            tally.refused += 1
            tally.lost += max(len(GOOD) - allowed, 0)
            continue
        found = Counter((record.name, record.data) for record in session.records)
        missing = sum((Counter(OCTETS) - found).values())
        if missing > allowed:
            tally.lost += missing - allowed
            print(f'{source.name}: {missing} messages are lost', flush=True)


def mutated_file(tally: Tally, dice: random.Random, folder: Path, files: list[tuple[Path, int]],
                 result: Path, *_: object) -> None:
    """Give a file whose bytes are mutated anywhere to the verbs."""
    source, _ = dice.choice(files)
    path = folder / f'file{source.suffix}'
    path.write_bytes(mutated(source.read_bytes(), dice))
    judged(tally, 'info', path, '--json')
    words = dice.choice((('fit', path), ('validate', result, path), ('plot', path)))
    judged(tally, *words, *(('--output', folder / 'plot.png') if words[0] == 'plot' else ('--json',)))


def mutated_documents(tally: Tally, dice: random.Random, folder: Path, files: list[tuple[Path, int]],
                      result: Path, request: Path) -> None:
    """Give mutated requests, results and metadata files to the verbs."""
    path = folder / 'document.xml'
    path.write_bytes(mutated(request.read_bytes(), dice))
    judged(tally, 'info', path, '--json')
    judged(tally, 'fit', path, '--json')
    path.write_bytes(mutated(result.read_bytes(), dice))
    judged(tally, 'validate', path, folder / 'ours', '--json')
    metadata = folder / 'ours' / 'metadata.yaml'
    whole = metadata.read_bytes()
    metadata.write_bytes(mutated(whole, dice))
    if judged(tally, 'info', folder / 'ours', '--json') is None:
        tally.lost += len(GOOD)
    metadata.write_bytes(whole)


def live(tally: Tally, dice: random.Random, folder: Path) -> None:
    """Let a node's session hear mutated messages among good ones, and calibrate."""
    graph = ToyGraph(folder, lambda _: ToySimulator(), **QUICK)
    try:
        graph.send(GOOD[:3])
        for _ in range(MESSAGES):
            kind, octets = dice.choice(serialised('camera'))
            graph.session.hear(kind, mutated(octets, dice))
            graph.session.tick()
            tally.tried += 1
        tally.refused += len(graph.logged['warn'])
        graph.send(GOOD[3:])
        tally.lost += max(2 - int(graph.status['trials']), 0)
        graph.calibrated()
        defects = [text for text in graph.logged['warn'] if 'please report it' in text]
        tally.died += len(defects)
        for text in defects:
            print(text, flush=True)
    except Exception as error:
        tally.died += 1
        print(f'live: {error!r}', flush=True)
    finally:
        graph.session.close()


def node(tally: Tally, dice: random.Random, folder: Path) -> None:
    """Publish mutated messages to a node in another process, between good ones, and let it calibrate."""
    from conftest import ros_graph
    import ros_robot

    with ros_graph(folder) as environment, \
            ros_robot.child(environment, folder / 'node', '-p', 'evaluations:=4') as process, \
            ros_robot.robot_of(environment) as robot:
        good = session_messages(ros_robot.TYPES, 2)
        robot.send(good[:3])
        robot.until_status(trials='1')
        for _ in range(FLOOD):
            kind, octets = dice.choice(serialised('camera'))
            # No ROS message has no bytes; after such a one, Fast DDS delivers nothing more of its publisher.
            robot.publishers[kind].publish(mutated(octets, dice) or bytes(4))
            tally.tried += 1
            robot.executor.spin_once(timeout_sec=0.001)
        robot.send(good[3:])
        robot.until_status(trials='2')
        robot.call('start')
        robot.until_result()
        tally.died += process.poll() is not None
    tally.remember(peak=resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024)
