"""The loop of a plant: start, lockstep or real time, end. The plant itself is an object with a few methods."""
import sys
import time

import numpy as np

from .connection import Connection, Member, Node
from .servo import CommandQueue, Refused
from .wire import CODES, REASONS, message

MOST_CATCH_UP_NS = 20_000_000
_PAUSE_S = 3e-5
_FAREWELL_S = 1.0
_FINISHED = CODES["status_flags"]["FINISHED"]


class Ended(Exception):
    """The run is over before the plant's last step, and why."""


def serve(plant, connection=None, answer_timeout_s=60.0):
    """Serves a run to its end, and returns when it is over. Raises `Ended` when somebody wanted the end before.

    The plant has:

        accept(command, now_ns)   takes a command whose time has come, or raises Refused: `Servo.accept`
        step()                    one step of `time.step_ns`
        fill(state)               what the sensors say now, all fields but the header
        fill_truth(state)         optional: the same without noise and delay, with the base
        is_over()                 optional: True when there is nothing more to see, a second after a fall
    """
    return _Loop(plant, connection or Connection.read(), answer_timeout_s).run()


class _Loop:
    def __init__(self, plant, connection, answer_timeout_s):
        self.plant, self.connection, self.timeout_s = plant, connection, answer_timeout_s
        self.node = Node(connection)
        self.member = Member(self.node, "plant")
        # The ear before the mouth: the answer to the first state must not be missed.
        try:
            self.commands = self.node.subscriber("command")
            self.states = self.node.publisher("state")
            self.truths = self.node.publisher("truth") if hasattr(plant, "fill_truth") else None
        except ConnectionError:
            self.member.refuse()
            raise
        self.queue, self.refused = CommandQueue(connection), 0
        self.state = self._blank()
        self.truth = self._blank()
        self.clock = CODES["clock"]["Monotonic" if connection.realtime else "Simulated"]
        self.time_ns, self.step_ns, self.start_ns = 0, connection["time"]["step_ns"], 0
        self.pauses = 0
        # Measurements on their way: all that a scenario's `sensors.delay_s` holds back.
        self.delay_steps = round(connection["time"]["sensor_delay_ns"] / self.step_ns)
        self.measured = []

    def _blank(self):
        connection = self.connection
        blank = message("PlantState", connection.message_run_id, connection.joint_set_hash, len(connection.joints))
        blank[0]["base_orientation_w"] = [0, 0, 0, 1]
        return blank

    def run(self):
        self._measure()
        self._tell_truth()
        self._first_answer()
        if self.connection.realtime:
            self._by_the_clock()
        else:
            self._cycle_by_cycle()
        self._farewell()

    def _send_state(self, flags=0):
        state, sequence = self.state[0], int(self.state[0]["header"]["sequence"])
        if self.delay_steps:
            self.state[...] = self.measured[0]
            state["header"]["sequence"] = sequence
        else:
            self.plant.fill(state)
        state["clock"] = self.clock
        state["status_flags"] |= flags
        state["header"]["sequence"] += 1
        if self.connection.realtime:
            state["header"]["sent_at_ns"] = time.monotonic_ns()
        self.states.send(self.state)

    def _measure(self):
        if self.delay_steps:
            fresh = self.measured.pop(0) if len(self.measured) > self.delay_steps else self._blank()
            self.plant.fill(fresh[0])
            self.measured.append(fresh)

    def _tell_truth(self):
        if self.truths is not None:
            truth = self.truth[0]
            self.plant.fill_truth(truth)
            truth["clock"] = self.clock
            truth["header"]["sequence"] += 1
            self.truths.send(self.truth)

    def _receive(self):
        """Takes the latest command; says which state it answers."""
        command = self.commands.latest()
        if command is None:
            return None
        try:
            self.queue.push(command, self.time_ns)
        except Refused as why:
            self._refuse(why)
            return None
        reason = int(command["reason"])
        if reason:
            self.member.say_once(f"warning: the controller refuses a state or a plan: {REASONS.get(reason, 'unknown')} (reason {reason})")
        return int(command["state_sequence"])

    def _refuse(self, why):
        self.refused += 1
        self.member.say_once(f"warning: a command is refused, and the first of a kind told so: {_kind(why)}")

    def _first_answer(self):
        self._send_state()
        answered = False
        while True:
            order = self.member.attend()
            if order not in ("wait", "run"):
                raise Ended(order)
            answered = self._receive() == 1 or answered
            if answered:
                self.member.announce("Ready")
                if order == "run":
                    self.member.announce("Running")
                    return
            self.states.serve_newcomers()
            time.sleep(_PAUSE_S)

    def _attend(self):
        order = self.member.attend()
        if order not in ("wait", "run"):
            raise Ended(order)

    def _step(self):
        while (command := self.queue.due(self.time_ns)) is not None:
            try:
                self.plant.accept(command, self.time_ns)
            except Refused as why:
                self._refuse(why)
        self.plant.step()
        self.time_ns += self.step_ns
        self._measure()
        self._tell_truth()
        return not (hasattr(self.plant, "is_over") and self.plant.is_over())

    def _cycle_by_cycle(self):
        per_cycle = self.connection["time"]["steps_per_cycle"]
        for index in range(self.connection["time"]["steps"]):
            if index and index % per_cycle == 0:
                self._send_state()
                self._answer()
            if not self._step():
                return

    def _answer(self):
        waited_s, looked = 0.0, time.monotonic()
        self._attend()
        while self._receive() != int(self.state[0]["header"]["sequence"]):
            self._attend()
            if self.member.peer_is_done():
                if self._receive() == int(self.state[0]["header"]["sequence"]):
                    return
                raise Ended("peer lost")
            self.states.serve_newcomers()
            time.sleep(_PAUSE_S)
            # Only time in which we were awake counts: a debugger's pause is a pause.
            now = time.monotonic()
            waited_s, looked = waited_s + min(now - looked, 0.2), now
            if not self.member.supervised and waited_s > self.timeout_s:
                raise Ended(f"no answer within {self.timeout_s} s")

    def _by_the_clock(self):
        self.start_ns = time.monotonic_ns()
        for _ in range(self.connection["time"]["steps"]):
            due_ns = self.start_ns + self.time_ns + self.step_ns
            wait_s = (due_ns - time.monotonic_ns()) * 1e-9
            if wait_s > 0:
                time.sleep(wait_s)
            late_ns = time.monotonic_ns() - due_ns
            if late_ns > MOST_CATCH_UP_NS:
                self.start_ns += late_ns
                self.pauses += 1
            self._attend()
            self._receive()
            goes_on = self._step()
            self._send_state()
            if not goes_on:
                return

    def _farewell(self):
        self._send_state(_FINISHED)
        begin = time.monotonic()
        while not self.member.peer_is_done() and (not self.connection.realtime or time.monotonic() < begin + _FAREWELL_S):
            if self.member.attend() not in ("wait", "run"):
                break
            self.states.serve_newcomers()
            time.sleep(_PAUSE_S)
        if self.pauses:
            print(f"the plant was held up {self.pauses} times: its world has paused", file=sys.stderr)
        self.member.announce("Finished")


def _kind(why):
    """The words of a refusal without its numbers, so that a kind is told once."""
    return " ".join("N" if any(c.isdigit() for c in word) else word for word in str(why).split()) if str(why).startswith("command ") else str(why)


def quaternion_xyzw(rotation):
    """Of a rotation matrix."""
    m = np.asarray(rotation, float)
    w = 1 + m[0, 0] + m[1, 1] + m[2, 2]
    x = 1 + m[0, 0] - m[1, 1] - m[2, 2]
    y = 1 - m[0, 0] + m[1, 1] - m[2, 2]
    z = 1 - m[0, 0] - m[1, 1] + m[2, 2]
    best = max(w, x, y, z)
    if best == w:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], w])
    elif best == x:
        q = np.array([x, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]])
    elif best == y:
        q = np.array([m[0, 1] + m[1, 0], y, m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]])
    else:
        q = np.array([m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], z, m[1, 0] - m[0, 1]])
    return q / np.linalg.norm(q)
