# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Followed file: where the DLO is in each image of a film, kept so that it need not be followed again."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any
import zipfile

import numpy as np

from dlo_calibration.capture.document import MarkEntry
from dlo_calibration.capture.following import Followed, plain_lens
from dlo_calibration.capture.json_values import JsonValue, plain
from dlo_calibration.errors import InputError
from dlo_calibration.reading import read_octets
from dlo_calibration.vision.lens import Lens
from dlo_calibration.vision.observer import ImageView
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tags import tag_poses
from dlo_calibration.vision.tracker import Tracked
from dlo_calibration.writing import write_file

MOST_OCTETS = 2**28  # an image has 1 to 2 kB
FORMAT = 1


def write_followed(path: Path, followed: Followed) -> None:
    """
    Write where the DLO is in each image of a film.

    :raises InputError: where it cannot be written.
    """
    views = followed.views
    scales = list({id(view.scale): view.scale for view in views if view.scale is not None}.values())
    numbers = {id(scale): k for k, scale in enumerate(scales)}
    reasons = list(dict.fromkeys(view.tracked.reason for view in views))
    tags = [(k, number, corners) for k, view in enumerate(views) for number, corners in view.tags.items()]
    lenses = list({id(scale.lens): scale.lens for scale in scales}.values())
    about = {'format': FORMAT, 'marks': plain(followed.marks), 'ruler': followed.ruler,
             'lens': plain_lens(followed.lens), 'problems': followed.problems, 'reasons': reasons,
             'lenses': [plain_lens(lens) for lens in lenses]}
    octets = io.BytesIO()
    np.savez(
        octets, about=np.frombuffer(json.dumps(about).encode(), np.uint8),
        times=[view.time for view in views], pixels=np.array([view.tracked.pixels for view in views]),
        widths=[view.tracked.width for view in views],
        reasons=[reasons.index(view.tracked.reason) for view in views],
        scales=[numbers.get(id(view.scale), -1) for view in views],
        lenses=np.array([lenses.index(scale.lens) for scale in scales], int),
        rotations=np.array([scale.rotation for scale in scales]).reshape(-1, 3, 3),
        translations=np.array([scale.translation for scale in scales]).reshape(-1, 3),
        tag_images=np.array([k for k, _, _ in tags], int),
        tag_numbers=np.array([number for _, number, _ in tags], int),
        tag_corners=np.array([corners for _, _, corners in tags]).reshape(-1, 4, 2))
    write_file(path, octets.getvalue())


def read_followed(path: Path) -> Followed | None:
    """Return what `write_followed` wrote; None: there is nothing, or it is damaged."""
    try:
        octets = read_octets(path, f'file {path}', 'a followed film', MOST_OCTETS)
        with zipfile.ZipFile(io.BytesIO(octets)) as members:
            if len(octets) > MOST_OCTETS or any(
                    member.compress_type != zipfile.ZIP_STORED for member in members.infolist()):
                return None  # it could unpack to any size
        with np.load(io.BytesIO(octets), allow_pickle=False) as arrays:
            return _followed({name: arrays[name] for name in arrays.files})
    except (InputError, OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError,
            zipfile.BadZipFile):
        return None


def _followed(arrays: dict[str, Any]) -> Followed:
    about = json.loads(arrays['about'].tobytes())
    if about['format'] != FORMAT:
        raise ValueError('another format')
    lenses = [_lens(values) for values in about['lenses']]
    scales = [Scale(lenses[lens], rotation, translation, np.zeros(1), True) for lens, rotation, translation
              in zip(arrays['lenses'], arrays['rotations'], arrays['translations'], strict=True)]
    tags: list[dict[int, Any]] = [{} for _ in arrays['times']]
    for image, number, corners in zip(*(arrays[f'tag_{name}'] for name in ('images', 'numbers', 'corners')),
                                      strict=True):
        tags[image][int(number)] = corners
    columns = (arrays[name] for name in ('times', 'pixels', 'widths', 'reasons', 'scales'))
    views = []
    for time, pixels, width, reason, which, seen in zip(*columns, tags, strict=True):
        scale = scales[which] if which >= 0 else None
        poses = {} if scale is None else {number: pose for number, corners in seen.items()
                                          if (pose := tag_poses(corners, scale)) is not None}
        tracked = Tracked(pixels, float(width), str(about['reasons'][reason]))
        views.append(ImageView(float(time), tracked, scale, seen, poses))
    lens = None if about['lens'] is None else _lens(about['lens'])
    marks = tuple(JsonValue('mark', mark).record(MarkEntry) for mark in about['marks'])
    return Followed(marks, float(about['ruler']), lens, tuple(views), tuple(map(str, about['problems'])))


def _lens(values: Any) -> Lens:
    size, matrix, coefficients, fisheye = values
    return Lens((int(size[0]), int(size[1])), np.array(matrix, float).reshape(3, 3),
                np.array(coefficients, float).ravel(), bool(fisheye))
