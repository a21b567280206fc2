# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the picture of film.md: three instants of a rendered film, with the calibrated simulation over them.

    python doc/make_film_picture.py [FILE]

It takes about a minute.
"""

from __future__ import annotations

from pathlib import Path
import sys
import tempfile
from typing import Any, Sequence

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from filmed_trials import clicks, film_camera, MASS, Move  # noqa: E402
from filmed_trials import filmed_trials as film_of  # noqa: E402
from films import write_film  # noqa: E402

from dlo_calibration import calibrate, Options  # noqa: E402
from dlo_calibration.capture.document import MarkEntry  # noqa: E402
from dlo_calibration.capture.filming import Filming  # noqa: E402
from dlo_calibration.capture.following import filmed_trials, views_of  # noqa: E402
from dlo_calibration.capture.trials import measured_options  # noqa: E402
from dlo_calibration.vision.film import read_film  # noqa: E402
from dlo_calibration.vision.view import BoardFinder, film_lens  # noqa: E402

BLUE, YELLOW = (0.10, 0.24, 0.55), (255, 214, 0)
RATE, SIZE = 15.0, (1280, 720)
LEFT, RIGHT, TOP, BOTTOM = 310, 1000, 40, 440  # px of the images that are shown
SHARES = (0.35, 0.7, 1.0)  # of the goals of the first trial
MOVES = (Move(12, (0.05, 0.18)), Move(52, (-0.1, 0.08), turn=-30.0))


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the picture."""
    given = sys.argv[1:] if arguments is None else arguments
    film, camera = film_of(MOVES, RATE), film_camera(SIZE)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'film.mp4'
        write_film(path, film.images(camera, colour=BLUE), RATE)
        video, problems = read_film(path), list[str]()
        mark = MarkEntry(0.0, tuple(map(tuple, clicks(film, camera).tolist())))
        views = views_of(video, [mark], BoardFinder(film_lens(video)), problems)
        filming = Filming()
        for view in views:
            filming.add(view)
        own = filmed_trials(filming, 21, problems)
        options = {**measured_options(2.0 * filming.radius, MASS, filmed=True), 'engine': 'compiled'}
        result = calibrate([each.trial for each in own], Options.of(options))
        trial, chains = own[0], result.chains[0]
        pictures: list[Any] = []
        for share in SHARES:
            k = round(share * (len(chains) - 1))
            time = trial.zero + trial.trial.goals[k].time
            view = min(views, key=lambda view: abs(view.time - time))
            assert view.scale is not None
            image = np.array(next(video.frames(view.time)).pixels)
            line = np.rint(view.scale.to_pixels(chains[k]) * 16).astype(np.int32)
            cv2.polylines(image, [line], False, YELLOW, 2, cv2.LINE_AA, 4)  # thinner than the rope
            pictures.append(image[TOP:BOTTOM, LEFT:RIGHT])
    whole = np.concatenate(pictures, axis=1)[..., ::-1]
    small = cv2.resize(whole, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    cv2.imwrite(given[0] if given else str(HERE / 'film.jpg'), small, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return 0


if __name__ == '__main__':
    sys.exit(main())
