"""Policies: the paper's tasks as environments of many trunks, training, paired evaluation, export to ONNX.

Gymnasium imports this package for ``"rfdropo_bayes.policies:TrunkReach-v0"``, and finds the tasks by name.
"""

from importlib.util import find_spec

from rfdropo_bayes.policies.registration import register

if find_spec("gymnasium") is not None:  # it comes with an extra
    register()
