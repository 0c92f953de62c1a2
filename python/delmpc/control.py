"""The loop of a controller: start, lockstep or real time, end. The controller itself is an object with one method."""
import time

from .connection import Connection, Member, Node
from .loop import Ended
from .wire import CODES, LIMITS, Invalid, message, validate_state

_PAUSE_S = 3e-5
_FINISHED = CODES["status_flags"]["FINISHED"]


def control(controller, connection=None, life_s=0.1):
    """Answers the states of a run to its end, and returns when it is over. Raises `Ended` when somebody wanted the end before.

    The controller has

        cycle(state, command, now_ns)   fills in torques, references and gains; `now_ns` is the plant's clock

    A command comes with zero torque and gain, without bounds, in one segment, valid from a period after its state on for `life_s`; all of it may
    be changed. A state that fails its checks is answered by BadState with the reason, and the controller does not see it.
    """
    return _Control(controller, connection or Connection.read(), life_s).run()


class _Control:
    def __init__(self, controller, connection, life_s):
        self.controller, self.connection, self.life_ns = controller, connection, round(life_s * 1e9)
        self.node = Node(connection)
        self.member = Member(self.node, "controller")
        try:
            self.commands = self.node.publisher("command")
            self.states = self.node.subscriber("state")
        except ConnectionError:
            self.member.refuse()
            raise
        self.period_ns = connection["time"]["cycle_ns"]
        self.sequence, self.state = 0, None

    def run(self):
        while True:
            began = time.monotonic_ns()
            order = self.member.attend()
            if order not in ("wait", "run"):
                raise Ended(order)
            state = self.states.latest()
            if state is not None and int(state["header"]["run_id"]) == self.connection.message_run_id:
                if int(state["status_flags"]) & _FINISHED:
                    self.member.announce("Finished")
                    return
                self._answer(state)
                self.member.announce("Ready")
                if self.connection.realtime:
                    time.sleep(max(0.0, (began + self.period_ns - time.monotonic_ns()) * 1e-9))
                continue
            if self.member.peer_is_done():
                self.member.announce("Finished")
                return
            self.commands.serve_newcomers()
            time.sleep(_PAUSE_S)

    def _answer(self, state):
        connection, n = self.connection, len(self.connection.joints)
        one = message("Command", connection.message_run_id, connection.joint_set_hash, n)
        command, began = one[0], time.monotonic_ns()
        now_ns = int(state["time_ns"]) + connection["time"]["sensor_delay_ns"]
        # The plant stands still until it has its first answer.
        first = int(state["header"]["sequence"]) == 1
        if connection.realtime and not first:
            now_ns += max(0, began - int(state["header"]["sent_at_ns"]))
        self.sequence = max(self.sequence, int(state["applied_command_sequence"])) + 1
        command["header"]["sequence"], command["state_sequence"] = self.sequence, state["header"]["sequence"]
        command["state_time_ns"] = state["time_ns"]
        command["valid_from_ns"] = int(state["time_ns"]) if first else now_ns + self.period_ns
        command["valid_until_ns"] = now_ns + self.period_ns + self.life_ns
        command["n_segments"] = command["rate_samples"] = 1
        segment = command["segments"][0]
        segment["torque_lower"], segment["torque_upper"] = -LIMITS["largest_effort"], LIMITS["largest_effort"]
        command["estimate"]["base_orientation_w"] = [0, 0, 0, 1]
        try:
            validate_state(state, connection.joint_set_hash, n, connection.message_run_id)
        except Invalid as why:
            self.member.say_once(f"warning: a state is refused: {why}")
            command["verdict"], command["reason"] = CODES["verdict"]["BadState"], why.reason
            # Valid at no time: the plant goes on with the command before, and then by its watchdog.
            command["valid_until_ns"] = command["valid_from_ns"]
        else:
            self.controller.cycle(state, command, now_ns)
        if connection.realtime:
            sent = time.monotonic_ns()
            command["header"]["sent_at_ns"], command["report"]["total_ns"] = sent, sent - began
        self.commands.send(one)
