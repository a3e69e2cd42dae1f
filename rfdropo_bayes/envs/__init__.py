"""The paper's tasks as environments that simulate many trunks at once, their parameters drawn at every reset.

Gymnasium imports this room when it is asked for ``"rfdropo_bayes.envs:TrunkReach-v0"``, and finds the tasks by name.
"""

from importlib.util import find_spec

from rfdropo_bayes.envs.registration import register

if find_spec("gymnasium") is not None:  # it comes with an extra
    register()
