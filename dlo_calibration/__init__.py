# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the physical parameters of a rope, cable, wire or hose from observed manipulations.

The public interface is what `__init__.pyi` imports: there, type checkers and editors find each name.  At run
time, a name is imported when it is first used, so that a program that starts from this package, such as the
node, can listen to signals before NumPy is loaded, and so that only those who use PyBullet load it.
"""

from importlib import import_module
from pathlib import Path
import re

_IMPORTS = Path(__file__).with_suffix('.pyi').read_text(encoding='utf-8')
_MODULES = {name: module for module, name in re.findall(r'^from (\S+) import (\w+)', _IMPORTS, re.MULTILINE)}
__all__ = list(_MODULES)


def __getattr__(name):
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__():
    return sorted({*globals(), *__all__})
