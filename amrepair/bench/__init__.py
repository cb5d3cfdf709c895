"""Bench: data sets, metrics, baselines and the runner that compares methods by name."""
