"""Report: what people see of a run. It reads results and never changes them."""
