"""Somebody else's controller against our plant: holds the posture of the start by springs and dampers in every joint.

    delmpc run configs/scenarios/littledog_trot.toml --set clock=lockstep --controller 'python3 examples/external_controller/controller.py'

The robot stands and does not trot: that is all this controller can. Put yours into `cycle`. Needs: pip install ./python
"""
import sys

import delmpc
import numpy as np
from delmpc.wire import MAX_JOINTS


class Posture:
    """Feed-forward, stiffness and damping of the scenario's own watchdog, which holds the start."""

    def __init__(self, connection):
        law = connection["watchdog"]["law"]
        self.torque, self.position, self.gain = (np.array(law[key]) for key in ("torque", "position_ref", "gain"))
        self.limit = np.array([1e9 if limit is None else limit for limit in connection["robot"]["effort_limit"]])

    def cycle(self, state, command, now_ns):
        """The law goes to the servo, which evaluates it at its own rate between two commands."""
        n = len(self.torque)
        segment = command["segments"][0]
        segment["torque"][:n], segment["position_ref"][:n] = self.torque, self.position
        segment["torque_lower"][:n], segment["torque_upper"][:n] = -self.limit, self.limit
        command["gain"][:n, :n], command["gain"][:n, MAX_JOINTS:MAX_JOINTS + n] = self.gain[:, :n], self.gain[:, n:]


if __name__ == "__main__":
    connection = delmpc.Connection.read()
    try:
        delmpc.control(Posture(connection), connection)
    except delmpc.Ended as why:
        sys.exit(f"the controller ends: {why}")
