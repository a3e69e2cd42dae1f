"""Results of a run for people and programs: summary.json, figures, the self-contained report.html."""

from rfdropo_bayes.report.baselines import BaselineErrors, baseline_errors
from rfdropo_bayes.report.facts import RecordingFacts, RunFacts, software_versions
from rfdropo_bayes.report.page import render_page
from rfdropo_bayes.report.run_files import rebuild_report, write_run
from rfdropo_bayes.report.scores import MeasuredPath, score
from rfdropo_bayes.report.summary import build_summary, read_summary
