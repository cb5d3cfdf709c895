"""Bench: data sets, metrics, baselines and the runner that compares methods by name."""

from amrepair.bench.registry import METHODS
from amrepair.bench.runner import BenchReport, run_bench
from amrepair.bench.synth import SynthOptions, synthesize

__all__ = ["METHODS", "BenchReport", "SynthOptions", "run_bench", "synthesize"]
