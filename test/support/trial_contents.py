# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""All that trials hold, comparable; and what a collector makes of its messages with other options."""


def contents(trials):
    """Return all that trials hold, comparable."""
    def octets(array):
        return None if array is None else (array.shape, array.tobytes())

    return [(t.name, octets(t.initial.points), octets(t.initial.hands), octets(t.velocity),
             [[(h.name, h.grips, octets(h.times), octets(h.positions), octets(h.orientations))
               for h in a.hands] for a in t.actions],
             [(octets(g.chain.points), g.time, g.stable, g.held_by) for g in t.goals]) for t in trials]


def anew(collector, options):
    """Return a collector with the same messages and other options."""
    other, steps = collector.with_options(options)
    assert list(steps)[-1:] in ([], [1])
    return other
