# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulate exported USD files with Newton's SolverVBD, on the processor.

The cantilevers tell which steps and iterations it needs.  On the table, the inertia of the segments about
their axis is raised: SolverVBD has no friction against rolling.

    pip install newton newton-usd-schemas usd-core
    python benchmark/export_newton.py [FOLDER] [--part cantilever|hanging|trials]

FOLDER keeps the calibrations of the reference objects (DLO_DATA) for the next time.  The tables are printed,
and written to benchmark/results/export_newton_PART.md.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
import tempfile
import time
from typing import Any, Sequence

from export_sdf import MadeUp
from figures import machine, table
import newton
import numpy as np
from replays import compared, elastica, Floats, Grip, LENGTH, MASS
import warp

from dlo_calibration import Chain, Options, Trial
from dlo_calibration.export import export_usd, ExportedRope
from dlo_calibration.model.parameters import BY_NAME, GRAVITY, PAPER_PARAMETERS, ParameterSpace

HERE = Path(__file__).resolve().parent
DRAG = 5.0  # 1/s, of cantilevers: without it a limp one swings for minutes
FALL = 3.0  # s, after which a cantilever with this drag is at rest
NODES, TRIALS = 21, 1
ROLLING = 1e4  # inertia about the axis, relative to mass times squared radius; with 1e6, a DLO may explode
HOLD = 0.1, 0.2  # stiffness and damping of a hand, relative to what one step of a free segment allows


@dataclass(frozen=True)
class Setting:
    """Time step [s], and iterations of SolverVBD in each."""

    step: float
    iterations: int


EXAMPLES = Setting(1 / 600, 5)  # those of newton/examples/cable
RECIPE = Setting(1 / 2000, 30)
MUCH = Setting(1 / 2000, 100)
#: EI [N m^2], segments, EA [N], internal damping [s] and setting, of cantilevers.
TRIED = (*((2e-2, 20, 300.0, 1e-3, setting) for setting in (
    EXAMPLES, Setting(1 / 600, 100), Setting(1 / 2000, 10), RECIPE, Setting(1 / 6000, 10))),
         (2e-2, 20, 3000.0, 1e-3, RECIPE), (2e-2, 20, 300.0, 1e-2, RECIPE),
         *((stiffness, 20, 300.0, 1e-3, RECIPE) for stiffness in (1e-3, 1e-5)),
         *((stiffness, 40, 300.0, 1e-3, RECIPE) for stiffness in (2e-2, 1e-3, 1e-5)),
         (2e-2, 40, 300.0, 1e-3, MUCH))


@warp.kernel
def slow_down(velocity: warp.array(dtype=warp.spatial_vector), mass: warp.array(dtype=float), drag: float,
              force: warp.array(dtype=warp.spatial_vector)):
    """Apply the drag to each body."""
    body = warp.tid()
    force[body] = warp.spatial_vector(-drag * mass[body] * warp.spatial_top(velocity[body]), warp.vec3(0.0))


@warp.kernel
def hold(pose: warp.array(dtype=warp.transform), velocity: warp.array(dtype=warp.spatial_vector),
         bodies: warp.array(dtype=int), places: warp.array(dtype=float),
         targets: warp.array(dtype=warp.vec3), speeds: warp.array(dtype=warp.vec3),
         gains: warp.array(dtype=warp.vec2), force: warp.array(dtype=warp.spatial_vector)):
    """Pull a point on the axis of a body to a hand, by a spring and a damper."""
    hand = warp.tid()
    body = bodies[hand]
    lever = warp.quat_rotate(warp.transform_get_rotation(pose[body]), warp.vec3(0.0, 0.0, places[hand]))
    point = warp.transform_get_translation(pose[body]) + lever
    speed = warp.spatial_top(velocity[body]) + warp.cross(warp.spatial_bottom(velocity[body]), lever)
    pull = gains[hand][0] * (targets[hand] - point) + gains[hand][1] * (speeds[hand] - speed)
    warp.atomic_add(force, body, warp.spatial_vector(pull, warp.cross(lever, pull)))


def without_rolling(model: newton.Model, radius: float) -> None:
    """Raise the inertia about the axes of segments: a bent DLO shall not roll until it is straight."""
    around = ROLLING * model.body_mass.numpy() * radius**2
    model.body_inertia.numpy()[:, 2, 2] = around  # on the processor, this is the memory of the model
    model.body_inv_inertia.numpy()[:, 2, 2] = 1 / around


class World:
    """Newton with one exported DLO."""

    def __init__(self, text: str, rope: ExportedRope, setting: Setting, drag: float, clamped: bool = False,
                 grips: Sequence[Grip] | None = None) -> None:
        builder, on_table = newton.ModelBuilder(), grips is not None
        with tempfile.NamedTemporaryFile('w', suffix='.usda') as file:
            file.write(text)
            file.flush()
            builder.add_usd(file.name)
        if clamped:
            builder.body_mass[0] = builder.body_inv_mass[0] = 0.0
            builder.body_inertia[0] = builder.body_inv_inertia[0] = warp.mat33(0.0)
            builder.body_flags[0] = int(newton.BodyFlags.KINEMATIC)
        if on_table:
            builder.add_ground_plane(height=rope.table, cfg=newton.ModelBuilder.ShapeConfig(mu=rope.friction))
        builder.color()
        self.model = builder.finalize(device='cpu')
        if on_table:
            without_rolling(self.model, rope.radius)
        self._pipeline = newton.CollisionPipeline(self.model, contact_matching='sticky') if on_table else None
        self._contacts = self._pipeline.contacts() if self._pipeline else None
        self._solver = newton.solvers.SolverVBD(self.model, iterations=setting.iterations,
                                                rigid_contact_history=on_table)
        self._states, self._control = [self.model.state(), self.model.state()], self.model.control()
        self._rope, self._drag, self._step, self._grips = rope, drag, setting.step, grips or ()
        self._half = rope.rest_lengths / 2
        places = [rope.place_of(float(rope.point_places[grip.point])) for grip in self._grips]
        self._bodies = warp.array([body for body, _ in places], dtype=int)
        self._places = warp.array([along - self._half[body] for body, along in places], dtype=float)
        self._targets, self._speeds = (warp.zeros(len(places), dtype=warp.vec3) for _ in range(2))
        self._gains = warp.zeros(len(places), dtype=warp.vec2)
        self._advance()  # compiles, before the same is recorded
        self.time = 2 * self._step
        with warp.ScopedCapture() as capture:
            self._advance()
        self._graph = capture.graph

    def _advance(self) -> None:
        """Simulate two steps: after them, the same of the two states is the present one."""
        for now, then in (self._states, self._states[::-1]):
            warp.launch(slow_down, self.model.body_count,
                        [now.body_qd, self.model.body_mass, self._drag, now.body_f])
            if self._grips:
                warp.launch(hold, len(self._grips), [now.body_q, now.body_qd, self._bodies, self._places,
                                                     self._targets, self._speeds, self._gains, now.body_f])
            if self._pipeline:
                self._pipeline.collide(now, self._contacts)
            self._solver.step(now, then, self._control, self._contacts, self._step)

    def simulate(self, until: float) -> None:
        """Simulate until a time [s]."""
        while self.time < until - 1e-9:
            self._move_hands()
            warp.capture_launch(self._graph)
            self.time += 2 * self._step

    def _move_hands(self) -> None:
        targets, speeds, gains = (array.numpy() for array in (self._targets, self._speeds, self._gains))
        mass = float(self._rope.masses[0])
        for k, grip in enumerate(self._grips):
            targets[k], after = ([np.interp(self.time + later, grip.times, axis) for axis in grip.positions.T]
                                 for later in (0.0, self._step))
            speeds[k] = (after - targets[k]) / self._step
            holds = grip.times[0] <= self.time < grip.times[-1]
            gains[k] = HOLD[0] * mass / self._step**2 * holds, HOLD[1] * mass / self._step * holds

    def points(self, places: Floats) -> Floats:
        """Return points of the DLO, (n, 3) [m], at arc lengths [m]."""
        poses, points = self._states[0].body_q.numpy().astype(float), []
        for body, along in map(self._rope.place_of, places.tolist()):
            x, y, z, w = poses[body, 3:]
            axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
            points.append(poses[body, :3] + (along - self._half[body]) * axis)
        return np.array(points)


def made_up(stiffness: float, stretching: float, damping: float) -> MadeUp:
    """Return a DLO with given EI [N m^2], EA [N] and internal damping [s]."""
    fixed = {name: BY_NAME[name].value(value) for name, value in (
        ('flexibility', stiffness), ('elasticity', stretching), ('internal_damping', damping))}
    return MadeUp(ParameterSpace(tuple(name for name in PAPER_PARAMETERS if name not in fixed), fixed, MASS))


def at_rest(dlo: Any, direction: tuple[float, float, float], segments: int, setting: Setting) -> Floats:
    """Return both ends of a DLO that was held at its first segment and let fall, (2, 3) [m]."""
    chain = Chain(np.linspace(0, LENGTH, 61)[:, None] * direction)
    options = Options(table=False, nodes=segments + 1)
    world = World(export_usd(dlo, chain, options=options), ExportedRope.of(dlo, chain, options), setting,
                  DRAG, clamped=True)
    world.simulate(FALL)
    return world.points(np.array([0.0, LENGTH]))


def cantilevers() -> str:
    """Return a table of cantilevers."""
    rows = []
    for stiffness, segments, stretching, damping, setting in TRIED:
        begun, length = time.process_time(), LENGTH / segments
        first, last = at_rest(made_up(stiffness, stretching, damping), (1, 0, 0), segments, setting)
        away = float(np.linalg.norm(last - first - elastica(stiffness, length / 2)))
        hardness = stiffness * setting.step**2 / (MASS / segments * length**3)
        seconds = (time.process_time() - begun) / FALL
        rows.append([f'{stiffness:g}', segments, f'{stretching:g}', f'{damping:g}',
                     f'1/{1 / setting.step:.0f}', setting.iterations, f'{hardness:.2g}',
                     f'{1e3 * away:.1f}', f'{100 * away / LENGTH:.2f}', f'{seconds:.1f}'])
        print(*rows[-1], flush=True)
    return table(['EI, N m²', 'segments', 'EA, N', 'internal damping, s', 'step, s', 'iterations',
                  'EI step² / (m l³)', 'tip from the elastica, mm', '% of the length',
                  'processor time of a second, s'], rows)


def stretches() -> str:
    """Return a table of hanging DLOs."""
    rows = []
    for stretching in (10.0, 100.0):
        held = LENGTH / 20 / 2  # the middle of the first segment
        first, last = at_rest(made_up(1e-3, stretching, 1e-3), (0, 0, -1), 20, RECIPE)
        expected = (LENGTH - held)**2 / 2 * MASS / LENGTH * GRAVITY / stretching
        rows.append([f'{stretching:g}', f'{1e3 * (np.linalg.norm(last - first) - LENGTH):.2f}',
                     f'{1e3 * expected:.2f}'])
        print(*rows[-1], flush=True)
    return table(['EA, N', 'Newton, mm', 'EA and weight, mm'], rows)


def replay(dlo: Any, trial: Trial, grips: list[Grip], end: float) -> Floats:
    """Return the points of a trial, (n, 3) [m]."""
    options = Options(nodes=NODES)
    rope = ExportedRope.of(dlo, trial.initial, options)
    text = export_usd(dlo, trial.initial, options=options)
    world = World(text, rope, RECIPE, rope.drag, grips=grips)
    world.simulate(end)
    return world.points(rope.point_places)


#: Of each part: what is measured, and how.
PARTS = {
    'cantilever': f"""A horizontal cantilever of {LENGTH:g} m and {MASS:g} kg, its first segment fixed,
{FALL:g} s after it was let fall with a drag of {DRAG:g}/s. The elastica begins in the middle of that segment.
The first row has the settings of most of Newton's own examples of cables; m and l are the mass and the
length of a segment.""",
    'hanging': f"""By how much a hanging DLO of {LENGTH:g} m and {MASS:g} kg becomes longer, its first segment
fixed; 20 segments.""",
    'trials': f"""The reference objects, fitted on four trials each, in one other trial each on the table,
with {NODES - 1} segments. The hands are springs. The found drag is applied as a force, which USD does not
have. The segments do not roll: their inertia about the axis is raised."""}


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', nargs='?', type=Path, help='keeps the calibrations')
    parser.add_argument('--part', choices=tuple(PARTS), help='default: all')
    chosen = parser.parse_args()
    warp.config.quiet = True
    for part in [chosen.part] if chosen.part else PARTS:
        with tempfile.TemporaryDirectory() as temporary:
            text = cantilevers() if part == 'cantilever' else stretches() if part == 'hanging' else \
                compared(chosen.folder or Path(temporary), replay, TRIALS)
        steps = '' if part == 'cantilever' else \
            f', steps of 1/{1 / RECIPE.step:.0f} s with {RECIPE.iterations} iterations'
        name = f'export_newton_{part}'
        (HERE / 'results' / f'{name}.md').write_text(
            f'# {name}\n\n`python benchmark/export_newton.py --part {part}`\n\n{PARTS[part]}\n\n'
            f'Newton {newton.__version__}, SolverVBD on the processor{steps}. {machine()}\n\n{text}\n',
            encoding='utf-8')
        print(text, flush=True)


if __name__ == '__main__':
    main()
