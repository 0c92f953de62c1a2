"""The messages: numpy types made of wire.json, codes, hashes, and the checks a receiver makes."""
import json
import math
from importlib import resources

import numpy as np

WIRE = json.loads(resources.files(__package__).joinpath("wire.json").read_text(encoding="utf-8"))
_PLAIN = {"u32": "<u4", "u64": "<u8", "f64": "<f8"}


def _types():
    found = {}
    for layout in WIRE["types"]:
        fields = layout["fields"]
        found[layout["name"]] = np.dtype({
            "names": [field["name"] for field in fields],
            "formats": [(_PLAIN.get(field["type"]) or found[field["type"]], tuple(field["shape"])) for field in fields],
            "offsets": [field["offset"] for field in fields],
            "itemsize": layout["size"],
        })
    return found


TYPES = _types()
PLANT_STATE, COMMAND, HEARTBEAT = TYPES["PlantState"], TYPES["Command"], TYPES["Heartbeat"]
MESSAGES = {message["name"]: message for message in WIRE["messages"]}
CODES = WIRE["codes"]
LIMITS = WIRE["limits"]
MAX_JOINTS, MAX_FEET = WIRE["capacity"]["joints"], WIRE["capacity"]["feet"]
MAX_SEGMENTS, MAX_RATE_SAMPLES = WIRE["capacity"]["segments"], WIRE["capacity"]["rate_samples"]
REASONS = {code: name for name, code in CODES["reason"].items()}
_COORDINATE, _EFFORT = LIMITS["largest_coordinate"], LIMITS["largest_effort"]


def joint_set_hash(names):
    """FNV-1a (64 bit) over joint names in order, each ended by a byte 0xff."""
    value = 0xCBF29CE484222325
    for name in names:
        for byte in name.encode() + b"\xff":
            value = ((value ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return value


def run_id(text):
    """The number of a run from its 16 hexadecimal digits, or from a name that somebody chose."""
    try:
        number = int(text, 16)
    except ValueError:
        return joint_set_hash([text])
    if len(text) != 16:
        raise ValueError(f"'{text}' is no run id: 16 hexadecimal digits are expected, or a name that is not all hexadecimal")
    return number


def message(name, message_run_id, joints_hash, n_joints=None):
    """A message of a type with its header filled in, sequence 0, all else zero, as an array of one element."""
    one = np.zeros(1, TYPES[name])
    header = one[0]["header"]
    header["magic"], header["version"] = MESSAGES[name]["magic"], MESSAGES[name]["version"]
    header["run_id"], header["joint_set_hash"] = message_run_id, joints_hash
    if n_joints is not None:
        one[0]["n_joints"] = n_joints
    return one


class Invalid(ValueError):
    """A message that cannot be used; `reason` is its number in `Command.reason`."""

    def __init__(self, reason, text):
        super().__init__(text)
        self.reason = CODES["reason"][reason]


def _header(found, name, joints_hash, message_run_id):
    header, expected = found["header"], MESSAGES[name]
    for reason, field, want in (("WrongMagic", "magic", expected["magic"]), ("WrongVersion", "version", expected["version"]),
                                ("WrongJointSet", "joint_set_hash", joints_hash)):
        if int(header[field]) != want:
            raise Invalid(reason, f"{name}: {field} is {int(header[field]):#x}, expected {want:#x}")
    if message_run_id is not None and int(header["run_id"]) != message_run_id:
        raise Invalid("WrongRun", f"{name}: of run {int(header['run_id']):016x}, this is run {message_run_id:016x}")


def _plausible(name, field, values, limit):
    if not np.isfinite(values).all():
        raise Invalid("NotFinite", f"{name}: {field} is not finite")
    if np.abs(values).max(initial=0.0) > limit:
        raise Invalid("Implausible", f"{name}: {field} is beyond {limit:g}")


def _known(name, field, value, codes):
    if int(value) not in codes.values():
        raise Invalid("UnknownCode", f"{name}: {field} = {int(value)} is no known code")


def validate_command(command, joints_hash, n, message_run_id=None):
    """Every check of `Command::validate`, and that it is of our run. Raises `Invalid`."""
    c, name = command, "Command"
    _header(c, name, joints_hash, message_run_id)
    if int(c["n_joints"]) != n or n > MAX_JOINTS:
        raise Invalid("WrongJointCount", f"{name}: {int(c['n_joints'])} joints, expected {n}")
    _known(name, "verdict", c["verdict"], CODES["verdict"])
    _known(name, "fallback_level", c["fallback_level"], CODES["watchdog_level, fallback_level"])
    begin, until = int(c["valid_from_ns"]), int(c["valid_until_ns"])
    if max(begin, until, int(c["state_time_ns"])) > LIMITS["latest_time_ns"]:
        raise Invalid("TimeBeyond", f"{name}: a time no clock shows")
    if begin > until:
        raise Invalid("EmptyInterval", f"{name}: valid from {begin} ns until {until} ns")
    if until - begin > LIMITS["longest_validity_ns"]:
        raise Invalid("ValidTooLong", f"{name}: valid for {until - begin} ns")
    count = int(c["n_segments"])
    if not 1 <= count <= MAX_SEGMENTS:
        raise Invalid("WrongSegmentCount", f"{name}: {count} segments")
    if not 1 <= int(c["rate_samples"]) <= MAX_RATE_SAMPLES:
        raise Invalid("UnknownCode", f"{name}: rate_samples = {int(c['rate_samples'])}")
    segments = c["segments"][:count]
    begins = [int(b) for b in segments["begin_ns"]]
    if begins[0] != 0 or any(b <= a for a, b in zip(begins, begins[1:])):
        raise Invalid("SegmentOutOfOrder", f"{name}: segments begin at {begins} ns")
    for field in ("torque", "torque_lower", "torque_upper", "acceleration_ref"):
        _plausible(name, field, segments[field][:, :n], _EFFORT)
    for field in ("position_ref", "velocity_ref"):
        _plausible(name, field, segments[field][:, :n], _COORDINATE)
    for field in ("imu_angle_ref", "imu_rate_ref", "imu_acceleration_ref"):
        _plausible(name, field, segments[field], _EFFORT)
    if (segments["torque_lower"][:, :n] > segments["torque_upper"][:, :n]).any():
        raise Invalid("EmptyBounds", f"{name}: torque_lower above torque_upper")
    gain = c["gain"][:n]
    _plausible(name, "gain", gain[:, :n], _EFFORT)
    _plausible(name, "gain", gain[:, MAX_JOINTS:MAX_JOINTS + n], _EFFORT)
    _plausible(name, "imu_gain", c["imu_gain"][:n], _EFFORT)
    if (c["load_foot"][:n] > MAX_FEET).any():
        raise Invalid("TooManyFeet", f"{name}: load_foot names a foot that does not exist")
    _plausible(name, "imu_rate_bias", c["imu_rate_bias"], _COORDINATE)
    for field, values in (("full_load_n", c["full_load_n"]), ("unloaded_stiffness", c["unloaded_stiffness"][:n]),
                          ("unloaded_damping", c["unloaded_damping"][:n])):
        _plausible(name, field, values, _EFFORT)
    estimate = c["estimate"]
    for field in ("base_angular_velocity_b", "base_linear_velocity_b", "gyro_bias", "accelerometer_bias"):
        _plausible(name, "estimate." + field, estimate[field], _COORDINATE)
    _plausible(name, "estimate.base_orientation_w", estimate["base_orientation_w"], 2.0)
    if not math.isfinite(c["report"]["worst_violation"]):
        raise Invalid("NotFinite", f"{name}: report.worst_violation")
    _known(name, "report.worst_constraint", c["report"]["worst_constraint"], CODES["report.worst_constraint"])


def validate_state(state, joints_hash, n, message_run_id=None):
    """The checks of `PlantState::validate`, and that it is of our run. Raises `Invalid`."""
    s, name = state, "PlantState"
    _header(s, name, joints_hash, message_run_id)
    if int(s["n_joints"]) != n or n > MAX_JOINTS:
        raise Invalid("WrongJointCount", f"{name}: {int(s['n_joints'])} joints, expected {n}")
    if int(s["time_ns"]) > LIMITS["latest_time_ns"]:
        raise Invalid("TimeBeyond", f"{name}: a time no clock shows")
    _known(name, "clock", s["clock"], CODES["clock"])
    _known(name, "watchdog_level", s["watchdog_level"], CODES["watchdog_level, fallback_level"])
    for field, limit in (("position", _COORDINATE), ("velocity", _COORDINATE), ("applied_torque", _EFFORT)):
        _plausible(name, field, s[field][:n], limit)
    feet, bits = int(s["n_feet"]), CODES["sensors"]
    if feet > MAX_FEET:
        raise Invalid("TooManyFeet", f"{name}: {feet} feet")
    groups = {"INERTIAL_UNIT": (("imu_angular_velocity", _COORDINATE), ("imu_specific_force", _COORDINATE)),
              "INERTIAL_SUMS": (("imu_angle", _EFFORT), ("imu_velocity", _EFFORT)),
              "MOTION_CAPTURE": (("base_position_w", _COORDINATE), ("base_orientation_w", 2.0),
                                 ("base_angular_velocity_b", _COORDINATE), ("base_linear_velocity_b", _COORDINATE))}
    for bit, fields in groups.items():
        if int(s["sensors"]) & bits[bit]:
            for field, limit in fields:
                _plausible(name, field, s[field], limit)
    for reading in s["feet"][:feet]:
        if int(reading["flags"]) & CODES["feet.flags"]["WRENCH"]:
            _plausible(name, "feet.torque_s", reading["torque_s"], _EFFORT)
            _plausible(name, "feet.force_s", reading["force_s"], _EFFORT)
    if int(s["sensors"]) & bits["MOTION_CAPTURE"]:
        length = float(np.dot(s["base_orientation_w"], s["base_orientation_w"]))
        if abs(length - 1) > LIMITS["quaternion_tolerance"]:
            raise Invalid("NotUnit", f"{name}: base_orientation_w has squared length {length}")
