# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""From photographs, and what a person says about them, to trials: as the capture page does it."""

from __future__ import annotations

from contextlib import closing

from dlo_calibration.capture.document import Document
from dlo_calibration.capture.project import Project
from dlo_calibration.capture.trials import Drafter


def drafted(folder, photographs, trials, dlo=None):
    """
    Return the drafts of photographs with the board.

    :param folder: of the project; a new one.
    :param photographs: name -> (content of the file, clicks (k, 2) [px]).
    :param trials: of the document, with names in place of ids.
    :param dlo: of the document: diameter [m], mass [kg], number of points.
    """
    with closing(Project(folder)) as project:
        ids, entries = {}, []
        for name, (octets, clicks) in photographs.items():
            ids[name] = project.add_photograph(octets, name)
            entries.append({'id': ids[name], 'name': name, 'scale': {'kind': 'board'},
                            'clicks': [list(map(float, click)) for click in clicks]})
        named = [{**trial, 'start': ids[trial['start']], 'goal': ids[trial['goal']]} for trial in trials]
        document = {'dlo': dlo or {}, 'photographs': entries, 'trials': named}
        project.change(Document.of(document), project.revision)
        return Drafter(project).draft(), ids
