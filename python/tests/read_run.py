"""What `delmpc.read` makes of a run's folder, against the summary in it: python3 python/tests/read_run.py FOLDER"""
import os
import sys

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

import delmpc  # noqa: E402

run = delmpc.read(sys.argv[1])
summary, n = run.summary, len(run.joints)
assert len(run.truth) == summary["steps"] + 1 and len(run.commands) == summary["cycles"], (len(run.truth), len(run.commands))
assert abs(run.truth["time_ns"][-1] * 1e-9 - summary["duration_s"]) < 1e-9
assert abs(run.truth["com_w"][:, 2].min() - summary["min_com_height_m"]) < 1e-12
assert (run.states["n_joints"] == n).all() and (run.commands["n_joints"] == n).all()
assert run.commands["report"]["qp_solves"].sum() == summary["qp_solves"]
plan, contacts = run.plan, run.contacts
assert plan["position"].shape[::2] == (len(run.commands), n) and np.isfinite(plan["position"][:, 0]).all()
assert contacts["touching"].shape == contacts["position_w"].shape[:2] and contacts["touching"].any()
# What was planned for a moment is near to what was true then.
times = run.truth["time_ns"] * 1e-9
at = np.searchsorted(times, plan["time_s"][:, 0].clip(max=times[-1]))
assert np.abs(run.truth["position"][at, :n] - plan["position"][:, 0]).max() < 0.2
try:
    import pandas  # noqa: F401
except ImportError:
    print("without pandas: no tables")
else:
    table = run.table("truth")
    assert len(table) == len(run.truth) and f"position.{run.joints[0]}" in table
print("read", len(run.truth), "steps,", len(run.states), "states,", len(run.commands), "commands")
