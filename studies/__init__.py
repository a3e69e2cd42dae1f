"""What is run for a paper: Table I, Table II, effects hidden from audits, checks of a method on simulated data.

``python -m studies COMMAND``, from the repository, with what studies/requirements.txt names installed. Studies add the
methods that RF-DROPO is compared with, and their folders, to the tables of the package.
"""

from rfdropo_bayes.inference.methods import METHODS, Method
from rfdropo_bayes.model.run_folder import COMMANDS, RunKind
from studies import rivals

METHODS["bayessim"] = Method(rivals.BayesSimConfig, rivals.run_bayessim)
METHODS["npdr"] = Method(rivals.NpdrConfig, rivals.run_npdr)
METHODS["udr"] = Method(rivals.UdrConfig, rivals.run_udr, posterior=False)

COMMANDS["sbc"] = RunKind(("sbc.json", "sbc.jsonl"), resumable=True)
COMMANDS["table1"] = RunKind(("table1.json", "table1.md", "table1.png", "fits.jsonl"), resumable=True, shared=True)
COMMANDS["table2"] = RunKind(("table2.json", "table2.md", "table2.png"), resumable=True, shared=True)
