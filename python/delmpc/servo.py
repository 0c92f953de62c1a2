"""What every plant links: the law between two commands, the queue of commands, torque bounds, the watchdog. As `shared/servo` in Rust."""
import numpy as np

from .wire import CODES, LIMITS, MAX_JOINTS, MAX_RATE_SAMPLES, Invalid, validate_command

_LEVEL = CODES["watchdog_level, fallback_level"]
FRESH, SHIFTED, STATIC = _LEVEL["FreshSolution"], _LEVEL["ShiftedPlan"], _LEVEL["StaticLqr"]
GRAVITY, DAMPING, ZERO = _LEVEL["GravityHold"], _LEVEL["DampingOnly"], _LEVEL["ZeroTorque"]
_OK = CODES["verdict"]["Ok"]


class Refused(Exception):
    """A command that is not taken; the one before stays in force."""


class CommandQueue:
    """Commands whose time has not come."""

    def __init__(self, connection):
        self._run, self._longest_lead_ns = connection.message_run_id, connection["time"]["longest_lead_ns"]
        self._waiting = []

    def push(self, command, now_ns):
        """Takes a command that came now. Raises `Refused` when it is of another run or of a time too far away."""
        if int(command["header"]["run_id"]) != self._run:
            raise Refused(f"command of run {int(command['header']['run_id']):016x}, this is run {self._run:016x}")
        begin = int(command["valid_from_ns"])
        if begin - now_ns > self._longest_lead_ns:
            raise Refused(f"command {int(command['header']['sequence'])} is valid from {begin} ns on and came at {now_ns} ns: too far ahead")
        self._waiting = self._waiting[-15:] + [command]

    def due(self, now_ns):
        """The next command whose time has come, or None."""
        if self._waiting and int(self._waiting[0]["valid_from_ns"]) <= now_ns:
            return self._waiting.pop(0)
        return None


class _Command:
    """A command taken apart once, so that a servo step costs a few products."""

    def __init__(self, command, n):
        c = command.copy()
        self.message, self.n = c, n
        self.sequence = int(c["header"]["sequence"])
        self.begin_ns, self.until_ns = int(c["valid_from_ns"]), int(c["valid_until_ns"])
        self.level, self.good = int(c["fallback_level"]), int(c["verdict"]) == _OK
        self.samples = int(c["rate_samples"])
        self.segments = c["segments"][:int(c["n_segments"])]
        self.begins = [int(b) for b in self.segments["begin_ns"]]
        self.gain_q, self.gain_v = c["gain"][:n, :n].copy(), c["gain"][:n, MAX_JOINTS:MAX_JOINTS + n].copy()
        self.gain_imu, self.bias = c["imu_gain"][:n].copy(), c["imu_rate_bias"]
        self.full_load, self.stiffness, self.damping = c["full_load_n"], c["unloaded_stiffness"], c["unloaded_damping"]
        self.on_foot = [(i, int(f) - 1) for i, f in enumerate(c["load_foot"][:n]) if f > 0 and self.full_load[int(f) - 1] > 0]

    def segment_at(self, now_ns):
        """Index of the segment in force, and how long it has been (s)."""
        elapsed = max(0, min(now_ns, self.until_ns) - self.begin_ns)
        at = 0
        for index, begin in enumerate(self.begins):
            if begin <= elapsed:
                at = index
        return at, (elapsed - self.begins[at]) * 1e-9

    def torque(self, now_ns, position, velocity, imu, load_n):
        """The law; `velocity` and the rate in `imu` are means."""
        n = self.n
        at, d = self.segment_at(now_ns)
        s = self.segments[at]
        moves = 1.0 if now_ns < self.until_ns else 0.0
        v_ref, a_ref = s["velocity_ref"][:n], s["acceleration_ref"][:n]
        error = position - s["position_ref"][:n] - d * (v_ref + 0.5 * d * a_ref)
        u = s["torque"][:n] + self.gain_q @ error + self.gain_v @ (velocity - moves * (v_ref + d * a_ref))
        if imu is not None:
            angle, rate = imu
            summed = max(0, max(now_ns, self.begin_ns) - (self.begin_ns + self.begins[at])) * 1e-9
            w_ref, dw_ref = s["imu_rate_ref"], s["imu_acceleration_ref"]
            e_angle = angle - s["imu_angle_ref"] - d * (w_ref + 0.5 * d * dw_ref) - self.bias * summed
            u += self.gain_imu @ np.concatenate([e_angle, rate - moves * (w_ref + d * dw_ref) - self.bias])
        u = np.minimum(np.maximum(u, s["torque_lower"][:n]), s["torque_upper"][:n])
        for i, foot in self.on_foot:
            load = load_n[foot] if foot < len(load_n) else None
            if load is not None:
                share = min(max(load / self.full_load[foot], 0.0), 1.0)
                u[i] = share * u[i] + (1.0 - share) * (-self.stiffness[i] * error[i] - self.damping[i] * velocity[i])
        return u


class Servo:
    """Servo and watchdog of `n` joints. `watchdog` is that of connection.json; without one there is no torque without a command."""

    def __init__(self, n, joint_set_hash, watchdog=None):
        w = watchdog or {}
        self.n, self.hash = n, joint_set_hash
        self.times = [w.get(key, 0.0) for key in ("hold_gains_s", "static_law_s", "gravity_hold_s", "damping_only_s")]
        self.good_commands = w.get("good_commands", 3)
        self.stiffness = np.array(w.get("stiffness") or np.zeros(n), float)
        self.damping = np.array(w.get("damping") or np.zeros(n), float)
        law = w.get("law")
        self.law = law and tuple(np.array(law[key], float) for key in ("torque", "position_ref", "gain"))
        self.level = STATIC if self.law else ZERO
        self.active = self.pending = None
        self.recovering, self.good_in_a_row, self.newest = False, 0, 0
        self.taken = self.refused = 0
        self._ring, self._count = np.zeros((MAX_RATE_SAMPLES, n + 3)), 0

    @property
    def applied_sequence(self):
        """Sequence of the command in force, 0: none."""
        return self.active.sequence if self.active else 0

    def accept(self, command, now_ns):
        """Takes a command that came at plant time `now_ns`. Raises `Refused` with why it does not."""
        try:
            self._check(command, now_ns)
        except (Invalid, Refused) as why:
            self.refused += 1
            self.good_in_a_row = 0
            raise why if isinstance(why, Refused) else Refused(str(why)) from why
        self.taken += 1
        taken = _Command(command, self.n)
        self.newest = taken.sequence
        self.good_in_a_row = self.good_in_a_row + 1 if taken.good else 0
        self.pending = taken
        self._promote(now_ns)

    def _check(self, command, now_ns):
        validate_command(command, self.hash, self.n)
        sequence, begin = int(command["header"]["sequence"]), int(command["valid_from_ns"])
        overtakes = self.pending is not None and begin <= max(self.pending.begin_ns, now_ns)
        if sequence <= self.applied_sequence or (sequence <= self.newest and not overtakes):
            raise Refused(f"command {sequence} came after command {self.newest}")
        if sequence - self.newest > LIMITS["largest_sequence_jump"]:
            raise Refused(f"command {sequence} came after command {self.newest}: a damaged number")
        if begin - now_ns > LIMITS["longest_lead_ns"]:
            raise Refused(f"command {sequence} is valid from {begin} ns on and came at {now_ns} ns: too far ahead")
        if int(command["valid_until_ns"]) <= now_ns:
            raise Refused(f"command {sequence} was valid until {int(command['valid_until_ns'])} ns and came at {now_ns} ns")

    def _promote(self, now_ns):
        if self.pending is not None and self.pending.begin_ns <= now_ns:
            self.active, self.pending = self.pending, None

    def torque(self, now_ns, position, velocity, imu=None, load_n=()):
        """The torque asked for at plant time `now_ns`, for what is measured then.

        `imu`: sum of the gyroscope's samples and its last sample, or None. `load_n`: normal force on each foot, None where no sensor is.
        """
        n = self.n
        samples = self.active.samples if self.active else 1
        self._ring[self._count % MAX_RATE_SAMPLES, :n] = velocity
        self._ring[self._count % MAX_RATE_SAMPLES, n:] = 0.0 if imu is None else imu[1]
        self._count += 1
        count = min(max(samples, 1), MAX_RATE_SAMPLES, self._count)
        mean = self._ring[[(self._count - 1 - back) % MAX_RATE_SAMPLES for back in range(count)]].mean(axis=0)
        self._promote(now_ns)
        self.level = self._level_at(now_ns)
        active = self.active
        if active is None and self.level == ZERO:
            return np.zeros(n)
        if active is not None and ((now_ns < active.until_ns and not self.recovering) or self.level == SHIFTED):
            return active.torque(now_ns, position, mean[:n], None if imu is None else (imu[0], mean[n:]), load_n)
        if self.level == STATIC and self.law:
            torque, reference, gain = self.law
            return torque + gain[:, :n] @ (position - reference) + gain[:, n:] @ velocity
        if self.level == GRAVITY and active is not None:
            last = active.segments[active.segment_at(active.until_ns)[0]]
            return last["torque"][:n] - self.stiffness * (position - last["position_ref"][:n]) - self.damping * velocity
        if self.level in (GRAVITY, DAMPING):
            return -self.damping * velocity
        return np.zeros(n)

    def _level_at(self, now_ns):
        if self.active is None:
            return STATIC if self.law else ZERO
        until = self.active.until_ns
        if now_ns < until:
            if self.recovering and self.good_in_a_row < self.good_commands:
                return self.level
            self.recovering = False
            return self.active.level
        left = (now_ns - until) * 1e-9
        hold, static, gravity, damping = self.times
        level = ZERO
        for rung, time in ((SHIFTED, hold), (STATIC, static if self.law else 0.0), (GRAVITY, gravity), (DAMPING, damping)):
            if left < time:
                level = rung
                break
            left -= time
        floor = self.level if self.recovering else level
        if level > SHIFTED:
            self.recovering, self.good_in_a_row = True, 0
        return max(level, floor)

    def on_watchdog(self, now_ns):
        """Whether the last torque was the watchdog's, not a valid command's."""
        return self.recovering or self.active is None or now_ns >= self.active.until_ns
