"""A policy was trained on one trunk. How often does it reach its goal on others?"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import rfdropo_bayes as rb

POLICY = Path(__file__).resolve().parents[1] / "models" / "policies" / "reach"
own = {"young_modulus": [4.0e6, 5.0e6], "trunk_mass": [0.38, 0.46], "poisson_ratio": [0.44, 0.46]}
other = own | {"young_modulus": [1.5e6, 2.0e6]}  # a softer silicone
model = rb.Model("trunk_sofa", simulator={"precision": "float32", "integrator": "euler"})  # as it was trained

limits, share = [5, 10, 15.25, 21.57, 30], {}
figure, axes = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
with TemporaryDirectory() as folder:
    for words, ranges in (("trunks as in training", own), ("softer trunks", other)):
        options = {"task": "TrunkReach-v0", "randomisation": "uniform", "ranges": ranges}
        found = rb.evaluate(model, [POLICY], Path(folder) / words, episodes=64, film=False, **options)
        success = found["policies"]["reach"]["success_mm"]
        share[words] = [success[f"{limit:g}"]["share"] for limit in limits]
        low, high = ([success[f"{limit:g}"][end] for limit in limits] for end in ("low", "high"))
        (line,) = axes.plot(limits, share[words], "o-", label=words)
        axes.fill_between(limits, low, high, color=line.get_color(), alpha=0.2)  # 95 % Wilson intervals
axes.set(xlabel="distance from the goal [mm]", ylabel="share of episodes", ylim=(0, 1.02))
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "evaluate_a_policy.png")
print(", ".join(f"{words}: {100 * values[1]:.0f} % within 10 mm" for words, values in share.items()))
assert share["trunks as in training"][1] > 0.9
