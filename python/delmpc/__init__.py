"""delmpc in Python: the messages as numpy types, the servo every plant links, the loop of a plant, and the log of a run.

    import delmpc
    delmpc.serve(MyPlant())          # a plant under `delmpc run SCENARIO --plant 'python3 my_plant.py'`
    delmpc.control(MyController())   # a controller under `delmpc run SCENARIO --controller 'python3 my_controller.py'`
    run = delmpc.read("runs/latest") # states, commands, plan, contacts as numpy arrays

What the messages mean and what a plant has to do is in shared/messages/WIRE.md; wire.json in this package is the same for programs.
"""
from .connection import Connection
from .control import control
from .log import read
from .loop import Ended, serve
from .servo import Refused, Servo
from .wire import COMMAND, HEARTBEAT, PLANT_STATE, joint_set_hash, run_id

__all__ = ["COMMAND", "Connection", "Ended", "HEARTBEAT", "PLANT_STATE", "Refused", "Servo", "control", "joint_set_hash", "read", "run_id", "serve"]
