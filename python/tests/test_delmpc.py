"""The package against vectors of the Rust servo, and against itself. Runs by itself or under pytest: python3 python/tests/test_delmpc.py"""
import json
import os
import sys

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.dirname(HERE))

from delmpc import servo as servo_module  # noqa: E402
from delmpc import wire  # noqa: E402
from delmpc.log import dtype_of  # noqa: E402
from delmpc.loop import quaternion_xyzw  # noqa: E402

with open(os.path.join(HERE, "servo_vectors.json"), encoding="utf-8") as file:
    VECTORS = json.load(file)


def made_command(told, joints_hash, n):
    """A message from what the vectors say of it."""
    one = wire.message("Command", VECTORS["message_run_id"], joints_hash, n)
    command = one[0]
    command["header"]["sequence"] = told["sequence"]
    for key in ("valid_from_ns", "valid_until_ns", "verdict", "fallback_level", "rate_samples", "imu_rate_bias", "full_load_n"):
        command[key] = told[key]
    command["n_segments"] = len(told["segments"])
    for segment, values in zip(command["segments"], told["segments"]):
        for key, value in values.items():
            if np.ndim(value) and not key.startswith("imu"):
                segment[key][:n] = value
            else:
                segment[key] = value
    gain = np.array(told["gain"])
    command["gain"][:n, :n], command["gain"][:n, wire.MAX_JOINTS:wire.MAX_JOINTS + n] = gain[:, :n], gain[:, n:]
    command["imu_gain"][:n] = told["imu_gain"]
    for key in ("load_foot", "unloaded_stiffness", "unloaded_damping"):
        command[key][:n] = told[key]
    return command


def test_the_servo_is_that_of_rust_to_round_off():
    n = len(VECTORS["joints"])
    joints_hash = wire.joint_set_hash(VECTORS["joints"])
    assert f"{joints_hash:016x}" == VECTORS["joint_set_hash"]
    servo = servo_module.Servo(n, joints_hash, VECTORS["watchdog"])
    worst, levels = 0.0, set()
    for step in VECTORS["steps"]:
        if step["sent"]:
            try:
                servo.accept(made_command(step["sent"]["command"], joints_hash, n), step["now_ns"])
                taken = True
            except servo_module.Refused:
                taken = False
            assert taken == step["sent"]["taken"], step["now_ns"]
        imu = (np.array(step["imu_angle"]), np.array(step["imu_rate"]))
        torque = servo.torque(step["now_ns"], np.array(step["position"]), np.array(step["velocity"]), imu, [step["load_n"]])
        worst = max(worst, float(np.abs(torque - step["torque"]).max()))
        levels.add(servo.level)
        assert servo.level == step["level"], (step["now_ns"], servo.level)
        assert servo.applied_sequence == step["applied_sequence"] and servo.on_watchdog(step["now_ns"]) == step["on_watchdog"]
    assert (servo.taken, servo.refused) == (VECTORS["taken"], VECTORS["refused"])
    assert worst < 1e-12 and levels == set(range(6)), (worst, levels)


def test_types_have_the_sizes_of_the_description():
    for layout in wire.WIRE["types"]:
        assert wire.TYPES[layout["name"]].itemsize == layout["size"]
    assert wire.COMMAND["gain"].shape == (32, 64)


def test_a_damaged_state_is_refused_with_its_reason():
    state = wire.message("PlantState", 3, 4, 2)[0]
    wire.validate_state(state, 4, 2, 3)
    for field, value, reason in (("velocity", np.nan, "NotFinite"), ("position", 1e300, "Implausible")):
        bad = state.copy()
        bad[field][1] = value
        assert refused(lambda: wire.validate_state(bad, 4, 2, 3)) == wire.CODES["reason"][reason]
    assert refused(lambda: wire.validate_state(state, 5, 2, 3)) == wire.CODES["reason"]["WrongJointSet"]
    assert refused(lambda: wire.validate_state(state, 4, 2, 9)) == wire.CODES["reason"]["WrongRun"]


def refused(call):
    try:
        call()
    except wire.Invalid as why:
        return why.reason
    return 0


def test_names_of_runs_are_hashes():
    assert wire.run_id("00000000000012ab") == 0x12AB
    assert wire.run_id("bench-3") == wire.joint_set_hash(["bench-3"])
    assert wire.joint_set_hash([]) == 0xCBF29CE484222325


def test_schemas_of_a_log_become_types():
    kind = dtype_of("uint32 n\nfloat64[3] x\npkg/Foot[2] feet\n====\nMSG: pkg/Foot\nuint32 flags\nuint32 zero\nfloat64 f\n")
    assert (kind.itemsize, kind.fields["x"][1], kind["feet"].shape) == (64, 8, (2,))


def test_quaternions_turn_back_into_their_rotation():
    random = np.random.default_rng(1)
    for _ in range(50):
        r = np.linalg.qr(random.normal(size=(3, 3)))[0]
        r *= np.linalg.det(r)
        x, y, z, w = quaternion_xyzw(r)
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        assert np.abs(np.eye(3) + 2 * w * k + 2 * k @ k - r).max() < 1e-12


if __name__ == "__main__":
    tests = [(name, test) for name, test in sorted(globals().items()) if name.startswith("test_")]
    for name, test in tests:
        test()
        print("ok", name)
    print(len(tests), "tests passed")
