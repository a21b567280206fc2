# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure contact with a scene: its speed, friction around a cylinder, and pegs beside PyBullet.

    python benchmark/touching.py

It takes two minutes.  The tables are printed, and written to benchmark/results/touching.md.
"""

from pathlib import Path
import sys
import time

from figures import HERE, machine, SAMPLES, table
import numpy as np

sys.path.insert(0, str(HERE.parent / 'test' / 'support'))
from touched_scenes import ALONG_Y, AROUND_ONE, obstacle, pegs, PHYSICAL, sliding_speed  # noqa: E402

from dlo_calibration import read_session  # noqa: E402
from dlo_calibration.simulation.bullet import BulletSimulator, FINER  # noqa: E402
from dlo_calibration.simulation.compiled import CompiledSimulator  # noqa: E402
from dlo_calibration.simulation.protocol import Stop  # noqa: E402

SETS, ROUNDS = 12, 7
SLIDES = 0.004  # m/s within a second; slower is creeping
ERRORS = np.arange(-0.1, 0.101, 0.01)  # of the coefficient of friction
PRIMITIVES = [
    obstacle('cylinder', (0.1, 0.005), (0.1, 0.08, 0.05)),
    obstacle('cylinder', (0.1, 0.01), (0.4, -0.1, 0.05)),
    obstacle('box', (0.05, 0.05, 0.02), (0.25, 0.12, 0.01)), obstacle('sphere', (0.02,), (0.3, -0.15, 0.02)),
    obstacle('capsule', (0.1, 0.01), (0.05, -0.12, 0.01), ALONG_Y),
    obstacle('box', (0.3, 0.02, 0.02), (0.25, 0.2, 0.01))]


def ball(radius: float, rings: int) -> np.ndarray:
    """Return the triangles of a sphere, (t, 3, 3) [m]."""
    around = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    points = np.array([[(np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)) for b in around]
                       for a in np.linspace(0, np.pi, rings + 1)]) * radius
    points[[0, -1]] = np.array([(0, 0, radius), (0, 0, -radius)])[:, None]
    upper, lower = points[:-1], points[1:]
    next_upper, next_lower = np.roll(upper, -1, axis=1), np.roll(lower, -1, axis=1)
    first = np.stack([upper, lower, next_lower], axis=2)[:-1]
    second = np.stack([upper, next_lower, next_upper], axis=2)[1:]
    return np.concatenate([first.reshape(-1, 3, 3), second.reshape(-1, 3, 3)])


def speeds() -> str:
    """Compare rounds of object 1 with and without a scene, four at a time; times of the processor."""
    session = read_session(SAMPLES / 'object1')
    space, random = session.options.space, np.random.default_rng(1)
    sets = [space.physical(space.values(random.random(len(space.free))), 0.6) for _ in range(SETS)]
    jobs = [(trial, physical) for physical in sets for trial in session.trials]
    triangles, begun = ball(0.03, 71), time.perf_counter()
    mesh = [obstacle('mesh', (1, 1, 1), (0.05, 0.05, 0.03), triangles=triangles)]
    scenes = {'table alone': [], 'six primitives': PRIMITIVES, f'mesh of {len(triangles)} triangles': mesh}
    engines = {name: CompiledSimulator(obstacles=obstacles) for name, obstacles in scenes.items()}
    read = time.perf_counter() - begun
    shortest = dict.fromkeys(engines, np.inf)
    for _ in range(ROUNDS):
        for name, engine in engines.items():
            begun = time.process_time()
            engine.simulate_together(jobs, Stop())
            shortest[name] = min(shortest[name], time.process_time() - begun)
    bullet, begun = BulletSimulator(obstacles=PRIMITIVES), time.process_time()
    for trial, physical in jobs[:8]:
        bullet.simulate(trial, physical)
    slow = (time.process_time() - begun) / 8 * len(jobs)
    bullet.close()
    alone = shortest['table alone']
    rows = [[name, f'{len(jobs) / seconds:.0f}', f'{alone / seconds:.2f}']
            for name, seconds in shortest.items()]
    rows.append([f'six primitives, PyBullet with {FINER} times as many steps', f'{len(jobs) / slow:.1f}',
                 f'{alone / slow:.4f}'])
    columns = ['object 1, random parameters', 'rounds per second of a processor', 'relative to the table']
    return (table(columns, rows)
            + f'\n\nThe mesh was read in {read:.1f} s. Six primitives are simulated '
            f'{slow / shortest["six primitives"]:.0f} times as fast as by PyBullet.')


def friction() -> str:
    """Find the least friction above which a rope around a cylinder always slides."""
    rows = []
    for angle in (np.pi, 3 * np.pi):
        for radius in (0.03, 0.05):
            for nodes in (41, 81):
                speeds = np.array([sliding_speed(1 + error, angle, radius, nodes) for error in ERRORS])
                error = ERRORS[np.flatnonzero(speeds < SLIDES).max(initial=0)] + ERRORS[1] - ERRORS[0]
                rows.append([f'{angle / np.pi / 2:.1f}', f'{1e3 * radius:.0f}', nodes,
                             f'{100 * error:+.0f}'])
    return table(['turns', 'radius, mm', 'nodes', 'error of the coefficient above which it slides, %'], rows)


def beside_bullet() -> str:
    """Compare a rope that is dragged around a peg with PyBullet, at finer and finer steps."""
    obstacles, rows = pegs((0.4, 0.05)), []
    default = CompiledSimulator(obstacles=obstacles).simulate(AROUND_ONE, PHYSICAL).chains
    for step in (0.003, 0.0015, 0.0005, 0.0002):
        engines = (CompiledSimulator(obstacles=obstacles, nodes=81, time_step=step),
                   BulletSimulator(obstacles=obstacles, nodes=81, time_step=step * FINER))
        ours, theirs = (engine.simulate(AROUND_ONE, PHYSICAL).chains for engine in engines)
        rows.append([f'{1e3 * step:.1f}', *(f'{1e3 * np.linalg.norm(other - default, axis=2).mean():.2f}'
                                            for other in (ours, theirs))])
        engines[1].close()
    return table(['step, ms', 'compiled, 81 nodes: mm from its default', 'PyBullet, 81 nodes: mm from it'],
                 rows)


def main() -> None:
    """Print the tables and write them."""
    parts = ['# Contact with a scene', f'`python benchmark/touching.py`\n\n{machine()}', speeds(), friction(),
             'A rope of 600 mm is dragged around a peg of 20 mm; the mean distance over three goals:',
             beside_bullet()]
    text = '\n\n'.join(parts) + '\n'
    print(text)
    (Path(__file__).resolve().parent / 'results' / 'touching.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
