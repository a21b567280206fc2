# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The DLOs of the samples, whose properties are known because their trials were made with them."""

from __future__ import annotations

from dataclasses import dataclass

from dlo_calibration.model.parameters import BY_NAME, ParameterSpace


@dataclass(frozen=True)
class KnownDlo:
    """
    A DLO with known properties.

    :param name: of its session in `msg_samples`.
    :param length: [m]; `radius` [m]; `mass` [kg].
    :param bending: bending stiffness EI [N m^2].
    :param stretching: stretching stiffness EA [N].
    :param friction: Coulomb coefficient.
    """

    name: str
    length: float
    radius: float
    mass: float
    bending: float
    stretching: float
    friction: float

    @property
    def values(self) -> dict[str, float]:
        """The paper's four parameters on the 0..100 scale."""
        true = {'flexibility': self.bending, 'elasticity': self.stretching, 'friction': self.friction,
                'self_collision': self.radius}
        return {name: BY_NAME[name].value(physical) for name, physical in true.items()}

    @property
    def physical(self) -> dict[str, float]:
        """Physical values by name, in SI units; parameters beyond the paper's have their defaults."""
        return ParameterSpace(mass=self.mass).physical(self.values, self.length)


#: From the table in msg_samples/README.md.
KNOWN_DLOS: tuple[KnownDlo, ...] = (
    KnownDlo('object1', 0.6, 4e-3, 0.030, 1e-4, 300.0, 0.4),
    KnownDlo('object2', 0.6, 7e-3, 0.090, 2e-3, 800.0, 0.5),
    KnownDlo('object3', 0.6, 2.5e-3, 0.008, 1e-5, 100.0, 0.3),
    KnownDlo('object4', 0.5, 3e-3, 0.020, 3e-4, 4.0, 0.6),
    KnownDlo('object5', 0.6, 10e-3, 0.350, 2e-2, 3000.0, 0.5),
)
