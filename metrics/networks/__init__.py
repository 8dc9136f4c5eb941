"""Networks of the metrics in plain torch, as functions of their weights."""
