# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
OptionsNode: a ROS node whose parameters are the options of the package.

Names, types, descriptors and ranges come from the declarations of the options;
unknown names and values out of range are refused.
"""

from __future__ import annotations

from typing import Any, Mapping, Sequence

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dlo_calibration.calibration.declaration import Declaration
from dlo_calibration.calibration.options import declarations, Options
from dlo_calibration.errors import InputError

#: Beginnings of the names of the parameters that rclpy declares itself.
ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
DECLARED: Mapping[str, Declaration] = {declaration.name: declaration for declaration in declarations()}


class OptionsNode(Node):
    """
    A node with the options as parameters.

    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, name: str, **arguments: Any) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **arguments)
        try:
            self._declare()
        except BaseException:
            self.destroy_node()
            raise

    def options(self) -> Options:
        """Return the options in force."""
        return Options.of({name: _plain(self.get_parameter(name).value) for name in DECLARED})

    def changed(self, names: Sequence[str]) -> None:
        """Do nothing; a subclass may override it to learn which parameters have new values."""

    def refuse(self, text: str) -> None:
        """Log why something was refused; a subclass may report it elsewhere, too."""
        self.get_logger().warning(text)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters together, as `rclpy.node.Node` does; a refusal is reported by `refuse`."""
        try:
            _checked({**self.options().flat(), **{
                p.name: _plain(p.value) for p in parameter_list if not p.name.startswith(ROS_PARAMETERS)}})
        except InputError as error:
            self.refuse(str(error))
            return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(parameter_list)

    def _declare(self) -> None:
        """Declare the parameters; those that the user gave replace what rclpy declared without a range."""
        given = {name: _plain(one.value) for name, one in self.get_parameters_by_prefix('').items()
                 if not name.startswith(ROS_PARAMETERS)}
        chosen = _checked(given)
        for name in given:
            self.undeclare_parameter(name)
        for name, value in chosen.flat().items():
            self.declare_parameter(name, value, _descriptor(DECLARED[name]), ignore_override=True)
        self.add_pre_set_parameters_callback(_as_declared)
        self.add_on_set_parameters_callback(self._check)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        new = {p.name: _plain(p.value) for p in parameters if p.name in DECLARED}
        try:
            _checked({**self.options().flat(), **new})
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if new:
            self.changed(list(new))
        return SetParametersResult(successful=True)


def _checked(flat: Mapping[str, Any]) -> Options:
    """Return options; raise InputError for a bad value, or for values that contradict each other."""
    options = Options.of(flat)
    options.space  # checks several options together  # noqa: B018
    return options


def _plain(value: Any) -> Any:
    """Return a parameter's value in the type that options expect; an array becomes a list."""
    return value if value is None or isinstance(value, (bool, int, float, str)) else list(value)


def _as_declared(parameters: list[Parameter]) -> list[Parameter]:
    """Convert integers to floats where a float is declared: `ros2 param set` sends an integer for 1."""
    return [Parameter(p.name, Parameter.Type.DOUBLE, float(p.value))
            if p.type_ == Parameter.Type.INTEGER and p.name in DECLARED
            and isinstance(DECLARED[p.name].default, float) else p for p in parameters]


def _descriptor(declaration: Declaration) -> ParameterDescriptor:
    """Return the descriptor of an option, which ROS tools show."""
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    descriptor = ParameterDescriptor(description=declaration.description + unit)
    if declaration.choices:
        descriptor.additional_constraints = f'one of {", ".join(declaration.choices)}'
    if declaration.minimum is not None and declaration.maximum is not None:
        low, high = declaration.minimum, declaration.maximum
        if isinstance(declaration.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor
