"""What a run leaves behind for people and programs: summary.json, figures, the self-contained report.html."""
