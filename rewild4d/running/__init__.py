"""Turn a plan into records: plan, run, resume, and describe what was run."""
