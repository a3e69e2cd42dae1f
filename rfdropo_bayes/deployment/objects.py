"""Objects of CiA 301 and CiA 402 used by master and simulated drive, and the layout of their process data."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

from rfdropo_bayes.errors import InputError

SIMULATED_EDS = Path(__file__).with_name("simulated_drive.eds")
"""Electronic data sheet of the simulated drive; users of real drives give their own drive's."""


class Object(IntEnum):
    """Indices of the object dictionary."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    ERROR_FIELD = 0x1003
    CYCLE_PERIOD = 0x1006  # [us]
    CONSUMER_HEARTBEAT = 0x1016  # node << 16 | ms
    PRODUCER_HEARTBEAT = 0x1017  # [ms]
    IDENTITY = 0x1018
    ERROR_BEHAVIOUR = 0x1029  # :1, if communication fails: 0 PRE-OPERATIONAL, 1 none, 2 STOPPED
    RPDO = 0x1400
    RPDO_MAP = 0x1600
    TPDO = 0x1800
    TPDO_MAP = 0x1A00
    SIMULATED_FAULT = 0x2F00
    ABORT_CONNECTION = 0x6007
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    QUICK_STOP_OPTION = 0x605A
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION_DEMAND = 0x6062
    POSITION = 0x6064
    FOLLOWING_WINDOW = 0x6065
    FOLLOWING_TIMEOUT = 0x6066  # [ms]
    VELOCITY = 0x606C
    MAX_TORQUE = 0x6072  # [per mille of rated]
    RATED_TORQUE = 0x6076  # [mN m]; vendors differ
    TORQUE = 0x6077  # [per mille of rated]
    TARGET_POSITION = 0x607A
    POSITION_RANGE = 0x607B  # range in which positions wrap; 0, 0 for none
    HOME_OFFSET = 0x607C
    POSITION_LIMIT = 0x607D
    POLARITY = 0x607E
    MAX_MOTOR_SPEED = 0x6080  # [1/min]; vendors differ
    QUICK_STOP_DECELERATION = 0x6085  # vendors differ
    VELOCITY_UNIT = 0x60A9  # of the drive's velocities, in a code
    ACCELERATION_UNIT = 0x60AA
    INTERPOLATION_TIME = 0x60C2
    FOLLOWING_ERROR = 0x60F4
    SUPPORTED_MODES = 0x6502
    PROFILE = 0x67FF  # of an axis: 402


_DEVICE, _AXIS, AXES = 0x6000, 0x800, 8  # first index of a device profile; indices of an axis; axes of a node at most
PDOS_OF_AXIS = 64  # offset of the second axis's process data from the first's


def of_axis(index: int, axis: int) -> int:
    """Index of a first-axis object on another axis, 0x800 further per axis. Objects outside the profile belong to the
    node.
    """
    return index + _AXIS * (axis - 1) if index >= _DEVICE else int(index)


def first_axis(index: int) -> tuple[int, int]:
    """The axis that an object belongs to, and its index on the first axis; objects of the node count as the first's."""
    axis = 1 + (index - _DEVICE) // _AXIS if index >= _DEVICE else 1
    return axis, index - _AXIS * (axis - 1)


PDO_INVALID = 1 << 31
CSP_BIT = 1 << 7  # of 0x6502

SETPOINT_MAP = ((Object.CONTROLWORD, 0, 16), (Object.TARGET_POSITION, 0, 32))  # first RPDO: applied on SYNC
COMMAND_MAP = ((Object.CONTROLWORD, 0, 16),)
"""Second RPDO: the controlword alone, applied at once, so that a stop needs no SYNC."""
STATUS_MAP = ((Object.STATUSWORD, 0, 16), (Object.POSITION, 0, 32), (Object.TORQUE, 0, 16))  # first TPDO: sent on SYNC

SETPOINT, COMMAND, STATUS = struct.Struct("<Hi"), struct.Struct("<H"), struct.Struct("<Hih")
EMERGENCY = struct.Struct("<HB5s")

NMT, SYNC = 0x000, 0x080
EMCY, TPDO1, RPDO1, RPDO2, HEARTBEAT = 0x080, 0x180, 0x200, 0x300, 0x700
"""Identifiers of the predefined connection set, to which the node is added."""
_PREDEFINED = ((RPDO1, RPDO2, TPDO1), (0x400, 0x500, 0x280))  # of the first axis, and of the second
_FREE = range(0x680, 0x6E0)  # ciA 301 gives them to nobody


class Identifiers(NamedTuple):
    """Frame identifiers of one axis: set-points, controlword alone, status."""

    set_point: int
    command: int
    status: int


def identifiers(places: Sequence[tuple[int, int]]) -> list[Identifiers]:
    """Identifiers of axes, given as (node, axis); no two of them share one.

    The predefined connection set has two RPDOs for each of two axes. Further axes use numbers that CiA 301 leaves free.

    Raises:
        InputError: too many axes.
    """
    free, assigned = iter(_FREE), []
    for node, axis in places:
        if axis <= len(_PREDEFINED):
            assigned.append(Identifiers(*(base + node for base in _PREDEFINED[axis - 1])))
            continue
        try:
            assigned.append(Identifiers(next(free), next(free), next(free)))
        except StopIteration:
            many = f"more than {len(_FREE) // 3} motors are on third or further axes"
            raise InputError(many, where="motors", remedy="spread them over nodes") from None
    return assigned


class Nmt(IntEnum):
    """Commands of network management."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """States of a node in its heartbeat."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class EmergencyCode(IntEnum):
    """Codes of emergency messages that the simulated drive sends (CiA 301 table 26, CiA 402 table 6)."""

    NONE = 0x0000
    GENERIC = 0x1000
    OVER_CURRENT = 0x2310
    SYNC_LOST = 0x8100
    HEARTBEAT_LOST = 0x8130
    PDO_SHORT = 0x8210
    FOLLOWING_ERROR = 0x8611
