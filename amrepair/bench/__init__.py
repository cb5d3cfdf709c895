"""Bench: data sets, metrics, baselines and the runner that compares methods by name."""

from amrepair.bench.registry import BENCH_METHODS
from amrepair.bench.runner import run_bench
from amrepair.bench.synth import SynthOptions, synthesize

__all__ = ["BENCH_METHODS", "SynthOptions", "run_bench", "synthesize"]
