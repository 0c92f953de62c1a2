"""MuJoCo as the plant of a delmpc scenario.

    delmpc run configs/scenarios/atlas_one_foot.toml --set clock=lockstep --plant 'python3 examples/mujoco/plant.py'

Everything about the run comes from DELMPC_CONNECTION; the options below are about MuJoCo. Needs: pip install ./python mujoco
"""
import argparse
import sys

import delmpc
import mujoco
import numpy as np
from delmpc.loop import quaternion_xyzw
from delmpc.wire import CODES

from robot import Robot, matrix, quat_wxyz

SENSORS, FOOT, STATUS = CODES["sensors"], CODES["feet.flags"], CODES["status_flags"]


def cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def log_so3(r):
    w = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    s = np.linalg.norm(w)
    return w if s < 1e-9 else w * (np.arctan2(s, 0.5 * (np.trace(r) - 1)) / s)


def half_turn(v):
    """Rotation by half of a small vector, to second order and made orthogonal by what it multiplies being tiny."""
    k = 0.5 * np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + k + 0.5 * k @ k


class Sensors:
    """Encoders, inertial unit and foot wrenches with the noise of the scenario's `sensors`."""

    def __init__(self, settings, n, step_s, seed):
        scale = settings["noise_scale"]
        self.on = {key: scale * value for key, value in settings.items() if isinstance(value, float) and key != "noise_scale"}
        self.random, self.n, self.step_s = np.random.default_rng(seed), n, step_s
        self.gyro_bias = self.on["gyro_bias_rad_s"] * self.random.normal(size=3)
        self.accelerometer_bias = self.on["accelerometer_bias_m_s2"] * self.random.normal(size=3)
        self.angle, self.velocity, self.last = np.zeros(3), np.zeros(3), None

    def read(self, q, v, rotation, velocity_w, omega_s, wrenches):
        """`rotation`: of the inertial unit in the world; `velocity_w` of its origin; `omega_s` in its axes."""
        on, normal, dt = self.on, self.random.normal, self.step_s
        resolution = on["position_resolution_rad"]
        self.q = q + on["position_noise_rad"] * normal(size=self.n)
        if resolution > 0:
            self.q = np.round(self.q / resolution) * resolution
        self.v = v + on["velocity_noise_rad_s"] * normal(size=self.n)
        gyro_noise = self.gyro_bias + on["gyro_noise_rad_s"] * normal(size=3)
        self.gyro = omega_s + gyro_noise
        acceleration_noise = self.accelerometer_bias + on["accelerometer_noise_m_s2"] * normal(size=3)
        if self.last is None:
            self.force = rotation.T @ np.array([0, 0, 9.81]) + acceleration_noise
        else:
            before, velocity_before = self.last
            turned = log_so3(before.T @ rotation)
            middle = before @ half_turn(turned)
            self.force = middle.T @ ((velocity_w - velocity_before) / dt + [0, 0, 9.81]) + acceleration_noise
            self.angle = self.angle + turned + gyro_noise * dt
            self.velocity = self.velocity + self.force * dt
        self.last = (rotation.copy(), velocity_w.copy())
        self.gyro_bias = self.gyro_bias + np.sqrt(dt) * on["gyro_bias_walk_rad_s"] * normal(size=3)
        self.accelerometer_bias = self.accelerometer_bias + np.sqrt(dt) * on["accelerometer_bias_walk_m_s2"] * normal(size=3)
        self.feet = [(torque + on["foot_torque_noise_nm"] * normal(size=3), force + on["foot_force_noise_n"] * normal(size=3))
                     for torque, force in wrenches]


class Plant:
    """The methods that `delmpc.serve` wants."""

    def __init__(self, connection, options):
        robot = Robot(connection)
        self.model = model = mujoco.MjModel.from_xml_string(robot.mjcf(connection, options))
        self.data = data = mujoco.MjData(model)
        self.n, self.step_ns = len(connection.joints), connection["time"]["step_ns"]
        self.step_s = self.step_ns * 1e-9
        self.substeps = max(1, round(self.step_s / options.dt))
        self.dof = np.array([model.joint(name).dofadr[0] for name in connection.joints])
        self.qpos = np.array([model.joint(name).qposadr[0] for name in connection.joints])
        feet = [foot["frame"] for foot in connection["robot"]["feet"]]
        self.site = [model.site(frame).id for frame in feet]
        self.foot_body = [model.body(robot.frame[frame]["link"]).id for frame in feet]
        self.root = model.body(connection["robot"]["base_link"]).id
        limit = lambda values: np.array([np.inf if value is None else value for value in values])  # noqa: E731
        self.effort, self.speed = limit(connection["robot"]["effort_limit"]), limit(connection["robot"]["velocity_limit"])
        self.limits_apply = connection["robot"]["torque_limits_apply"]
        self.pushes = [(model.body(p["link"]).id, np.array(p["direction_w"]) * p["impulse_ns"] / p["duration_s"], p["start_s"],
                        p["start_s"] + p["duration_s"]) for p in connection["pushes"]]
        unit = connection["robot"]["inertial_unit"]
        self.imu_body = model.body(unit["link"]).id
        self.imu_turn, self.imu_at = matrix(unit["orientation"]), np.array(unit["position"])

        start = connection["robot"]["start"]
        data.qpos[self.qpos] = start["position"]
        data.qpos[:3], data.qpos[3:7] = start["base_position_w"], quat_wxyz(matrix(start["base_orientation_w"]))
        mujoco.mj_forward(model, data)
        self.time_ns, self.torque, self.saturated = 0, np.zeros(self.n), False
        weight = model.body_mass.sum() * 9.81
        lowest = min(data.site_xpos[s][2] for s in self.site)
        self.wrench = []
        for site in self.site:
            stands = data.site_xpos[site][2] < lowest + 0.01
            self.wrench.append((np.zeros(3), np.array([0, 0, weight if stands else 0.0])))
        share = max(1, sum(force[2] > 0 for _, force in self.wrench))
        self.wrench = [(torque, force / share) for torque, force in self.wrench]
        self.start_height, self.start_up = data.subtree_com[self.root][2] - lowest, self._rotation(self.root)[2].copy()
        self.fell_ns = None
        self.servo = delmpc.Servo(self.n, connection.joint_set_hash, connection["watchdog"])
        self.accept = self.servo.accept
        self.sensors = Sensors(connection["sensors"], self.n, self.step_s, connection["seed"] if options.seed is None else options.seed)
        self._read()

    def _rotation(self, body):
        return self.data.xmat[body].reshape(3, 3)

    def _read(self):
        data = self.data
        turn = self._rotation(self.imu_body)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_XBODY, self.imu_body, velocity, 0)
        velocity_w = velocity[3:] + cross(velocity[:3], turn @ self.imu_at)
        rotation = turn @ self.imu_turn
        self.sensors.read(data.qpos[self.qpos], data.qvel[self.dof], rotation, velocity_w, rotation.T @ velocity[:3], self.wrench)

    def step(self):
        """One step of the plant: servo on the readings of this moment, motors, MuJoCo's steps, readings."""
        sensors, data = self.sensors, self.data
        asked = self.servo.torque(self.time_ns, sensors.q, sensors.v, (sensors.angle, sensors.gyro), [force[2] for _, force in sensors.feet])
        limit = self.effort.copy()
        speed = data.qvel[self.dof]
        if self.limits_apply:
            # A motor that drives loses its torque over the last tenth of its speed.
            driving = asked * speed > 0
            limit[driving] *= np.clip((1 - np.abs(speed[driving]) / self.speed[driving]) / 0.1, 0, 1)
            self.torque = np.clip(asked, -limit, limit)
        else:
            self.torque = asked
        self.saturated = bool((self.torque != asked).any())
        data.qfrc_applied[self.dof] = self.torque
        total = [[np.zeros(3), np.zeros(3)] for _ in self.site]
        dt = self.model.opt.timestep
        for index in range(self.substeps):
            middle = self.time_ns * 1e-9 + (index + 0.5) * dt
            for body, force, begin, end in self.pushes:
                data.xfrc_applied[body, :3] = force if begin <= middle < end else 0.0
            mujoco.mj_step(self.model, data)
            self._add_wrenches(total)
        self.wrench = total
        self.time_ns += self.step_ns
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_comVel(self.model, data)
        self._read()
        self._look_whether_it_fell()

    def _add_wrenches(self, total):
        """Wrench of the ground on each foot about its sole's origin, in the axes of the sole, as mean over the step."""
        data = self.data
        mujoco.mj_rnePostConstraint(self.model, data)
        com = data.subtree_com[self.root]
        for (torque, force), body, site in zip(total, self.foot_body, self.site):
            external = data.cfrc_ext[body]
            if external.any():
                r = data.site_xmat[site].reshape(3, 3)
                torque += r.T @ (external[:3] + cross(com - data.site_xpos[site], external[3:])) / self.substeps
                force += r.T @ external[3:] / self.substeps

    def _look_whether_it_fell(self):
        height = self.data.subtree_com[self.root][2] - min(self.data.site_xpos[s][2] for s in self.site)
        lean = np.arccos(np.clip(self._rotation(self.root)[2] @ self.start_up, -1, 1))
        if self.fell_ns is None and (height < 0.5 * self.start_height or lean > 1.0 or not np.isfinite(height)):
            self.fell_ns = self.time_ns

    def is_over(self):
        """A second after a fall there is nothing more to see."""
        return self.fell_ns is not None and self.time_ns > self.fell_ns + 1_000_000_000

    def _common(self, state):
        n, servo = self.n, self.servo
        state["time_ns"] = self.time_ns
        state["applied_command_sequence"] = servo.applied_sequence
        state["n_feet"] = len(self.site)
        state["status_flags"] = ((STATUS["FELL"] if self.fell_ns is not None else 0) | (STATUS["SATURATED"] if self.saturated else 0)
                                 | (STATUS["WATCHDOG"] if servo.on_watchdog(self.time_ns) else 0))
        state["watchdog_level"] = servo.level
        state["applied_torque"][:n] = self.torque

    def _fill_feet(self, state, wrenches):
        for reading, (torque, force), (_, true) in zip(state["feet"], wrenches, self.wrench):
            reading["flags"] = FOOT["WRENCH"] | (FOOT["TOUCHES"] if true.any() else 0)
            reading["torque_s"], reading["force_s"] = torque, force

    def fill(self, state):
        """What the sensors say."""
        sensors, n = self.sensors, self.n
        self._common(state)
        state["sensors"] = SENSORS["INERTIAL_UNIT"] | SENSORS["INERTIAL_SUMS"]
        state["position"][:n], state["velocity"][:n] = sensors.q, sensors.v
        state["imu_angle"], state["imu_velocity"] = sensors.angle, sensors.velocity
        state["imu_angular_velocity"], state["imu_specific_force"] = sensors.gyro, sensors.force
        self._fill_feet(state, sensors.feet)

    def fill_truth(self, state):
        """What is true."""
        data, n = self.data, self.n
        self._common(state)
        state["sensors"] = SENSORS["MOTION_CAPTURE"]
        state["position"][:n], state["velocity"][:n] = data.qpos[self.qpos], data.qvel[self.dof]
        self._fill_feet(state, self.wrench)
        r = self._rotation(self.root)
        state["base_position_w"], state["base_orientation_w"] = data.qpos[:3], quaternion_xyzw(r)
        state["base_angular_velocity_b"], state["base_linear_velocity_b"] = data.qvel[3:6], r.T @ data.qvel[:3]


def options():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dt", type=float, default=5e-4, help="MuJoCo's step (s)")
    parser.add_argument("--solref", default="0.002 1", help="contact time constant (s) and damping ratio; MuJoCo's own default: '0.02 1'")
    parser.add_argument("--solimp", default="0.9 0.95 0.001", help="contact impedance")
    parser.add_argument("--impratio", type=float, default=100, help="friction against normal impedance; MuJoCo's own default: 1")
    parser.add_argument("--seed", type=int, help="of the sensors' noise; as in the scenario where it is not given")
    return parser.parse_args()


if __name__ == "__main__":
    given = delmpc.Connection.read()
    try:
        delmpc.serve(Plant(given, options()), given)
    except delmpc.Ended as why:
        sys.exit(f"the plant ends: {why}")
