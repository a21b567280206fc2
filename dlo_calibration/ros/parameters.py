# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
OptionsNode: a ROS node whose parameters are the options of a class.

Names, types, descriptors and ranges come from the declarations of the options;
unknown names and values out of range are refused.
"""

from __future__ import annotations

from typing import Any, Generic, Mapping, Sequence, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dlo_calibration.calibration.declaration import Declaration, DeclaredOptions
from dlo_calibration.errors import InputError
from dlo_calibration.ros.parameter_file import NO_TEXTS

#: Beginnings of the names of the parameters that rclpy declares itself.
ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')

Chosen = TypeVar('Chosen', bound=DeclaredOptions)


class OptionsNode(Node, Generic[Chosen]):
    """
    A node with the options of a class as parameters.

    :param kind: the class.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, name: str, kind: type[Chosen], **arguments: Any) -> None:
        self._kind = kind
        self._declared: Mapping[str, Declaration] = {one.name: one for one in kind.declarations()}
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **arguments)
        try:
            self._declare()
        except BaseException:
            self.destroy_node()
            raise

    def options(self) -> Chosen:
        """Return the options in force."""
        return self._kind.of({name: _plain(self.get_parameter(name).value) for name in self._declared})

    def changed(self, names: Sequence[str], options: Chosen) -> None:
        """
        Do nothing; a subclass may override it to learn which parameters get new values.

        :param options: with the new values.
        :raises InputError: if the subclass refuses them.
        """

    def refuse(self, text: str) -> None:
        """Log why something was refused; a subclass may report it elsewhere, too."""
        self.get_logger().warning(text)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters together, as `rclpy.node.Node` does; a refusal is reported by `refuse`."""
        try:
            self._checked({**self.options().flat(), **{
                p.name: _plain(p.value) for p in parameter_list if not p.name.startswith(ROS_PARAMETERS)}})
        except InputError as error:
            self.refuse(str(error))
            return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(parameter_list)

    def _declare(self) -> None:
        """Declare the parameters; those that the user gave replace what rclpy declared without a range."""
        given = {name: _plain(one.value) for name, one in self.get_parameters_by_prefix('').items()
                 if not name.startswith(ROS_PARAMETERS)}
        chosen = self._checked(given)
        for name in given:
            self.undeclare_parameter(name)
        for name, value in chosen.flat().items():
            self.declare_parameter(name, NO_TEXTS if value == [] else value,
                                   _descriptor(self._declared[name]), ignore_override=True)
        self.add_pre_set_parameters_callback(self._as_declared)
        self.add_on_set_parameters_callback(self._check)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        new = {p.name: _plain(p.value) for p in parameters if p.name in self._declared}
        try:
            options = self._checked({**self.options().flat(), **new})
            if new:
                self.changed(list(new), options)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _checked(self, flat: Mapping[str, Any]) -> Chosen:
        """Return options; raise InputError for a bad value, or for values that contradict each other."""
        options = self._kind.of(flat)
        options.check_together()
        return options

    def _as_declared(self, parameters: list[Parameter]) -> list[Parameter]:
        """
        Convert parameters to the types of their declarations.

        `ros2 param set` sends an integer for 1, a text for a list of one, and for [] a list of other things.
        """
        return [_in_type_of(self._declared[p.name], p) if p.name in self._declared else p for p in parameters]


def _plain(value: Any) -> Any:
    """Return a parameter's value in the type that options expect: a list for an array, empty for NO_TEXTS."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return [] if list(value) == NO_TEXTS else list(value)


def _in_type_of(declaration: Declaration, given: Parameter) -> Parameter:
    """Return a parameter in the type of its declaration where that means the same."""
    if isinstance(declaration.default, float) and given.type_ == Parameter.Type.INTEGER:
        return Parameter(given.name, Parameter.Type.DOUBLE, float(given.value))
    if isinstance(declaration.default, tuple) and _plain(given.value) == []:
        return Parameter(given.name, Parameter.Type.STRING_ARRAY, NO_TEXTS)
    if isinstance(declaration.default, tuple) and given.type_ == Parameter.Type.STRING:
        return Parameter(given.name, Parameter.Type.STRING_ARRAY, [given.value])
    return given


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
