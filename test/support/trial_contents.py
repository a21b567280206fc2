# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""All that trials hold, comparable."""


def contents(trials):
    """Return all that trials hold, comparable."""
    def octets(array):
        return None if array is None else (array.shape, array.tobytes())

    return [(t.name, octets(t.initial.points), octets(t.initial.hands), octets(t.velocity),
             [[(h.name, h.grips, octets(h.times), octets(h.positions), octets(h.orientations))
               for h in a.hands] for a in t.actions],
             [(octets(g.chain.points), g.time, g.stable, g.held_by) for g in t.goals]) for t in trials]
