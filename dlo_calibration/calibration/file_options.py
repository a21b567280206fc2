# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
FileOptions: the options in a file, as far as a file may set them.

All options that come out of a session, a request or a result pass through `file_options`.
A file may come from a stranger: it never chooses machines, processes or folders, and names
no file outside its own folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Mapping

from dlo_calibration.calibration.declaration import MACHINE
from dlo_calibration.calibration.options import names_of, Options
from dlo_calibration.errors import InputError


@dataclass(frozen=True)
class FileOptions:
    """
    Options of a file, by name.

    :param values: those to use, without the machine's; `scene` is an absolute path.
    :param problems: a text for what is left out.
    :param refusal: why the scene is left out; without it, there is nothing to simulate.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    refusal: InputError | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'values', MappingProxyType(dict(self.values)))

    def options(self) -> Options:
        """
        Return all options; those that the file does not set have their default.

        :raises InputError: if the file names a scene that cannot be used.
        """
        if self.refusal is not None:
            raise self.refusal
        return Options.of(self.values)


def file_options(given: Mapping[str, Any], folder: Path | None) -> FileOptions:
    """
    Return the options of a file that this version knows and accepts, and that a file may set.

    :param given: as in the file, of any names, types and values.
    :param folder: of the file; None: it came as a message, or as bytes.
    """
    usable: dict[str, Any] = {}
    problems = []
    for name, value in given.items():
        try:
            Options.of({name: value})
        except InputError as error:
            problems.append(f'a recorded option is left out: {error}')
        else:
            usable[name] = value
    defaults = Options().flat()
    ignored = [name for name in names_of(MACHINE) if usable.pop(name, defaults[name]) != defaults[name]]
    if ignored:
        problems.append(f'recorded options are left out, as only the command line or the node may set them: '
                        f'{", ".join(ignored)}')
    try:
        if usable.get('scene'):
            usable['scene'] = str(_scene(usable['scene'], folder))
    except InputError as error:
        del usable['scene']
        return FileOptions(usable, (*problems, str(error)), error)
    return FileOptions(usable, tuple(problems))


def recordable(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that a file records: all but the machine's."""
    machine = names_of(MACHINE)
    return {name: value for name, value in options.items() if name not in machine}


def _scene(name: str, folder: Path | None) -> Path:
    """
    Return the path of a scene that a file names, if it lies in the folder of the file.

    A scene that was elsewhere when it was recorded is found under its name in that folder.

    :raises InputError: if there is no such regular file in the folder, whatever lies elsewhere.
    """
    if folder is not None:
        try:
            home = folder.resolve()
            for path in ((home / name).resolve(), (home / Path(name).name).resolve()):
                if path.is_relative_to(home) and path.is_file():
                    return path
        except (OSError, ValueError, RuntimeError):  # a name that no file can have, or a loop of links
            pass
    raise InputError(f'recorded scene {name}', 'no such file in the folder of the recording',
                     'a scene that lies there' if folder is not None else 'no scene',
                     'copy the scene to that folder, or give it with --scene')
