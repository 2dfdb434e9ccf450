//! Progress, run.json, report.html.
