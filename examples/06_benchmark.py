"""A data set with labelled defects made from our own part, and methods compared on it.

python examples/06_benchmark.py        writes a data set and results.{json,csv,md}
"""

from __future__ import annotations

from _shared import PARTS, out_folder

from amrepair.bench import SynthOptions, run_bench, synthesize

LAYOUT = "anomaly-shapenet"


def main() -> None:
    out = out_folder(__doc__)
    # small, so that it takes seconds; leave the options out for sizes that say something
    options = SynthOptions(train=2, normal=3, per_defect=1, points=2000)
    data = synthesize([PARTS / "knob.stl"], out / "set", LAYOUT, 0, options=options)
    report = run_bench(
        data, format=LAYOUT, methods=["btf-raw", "btf-fpfh"], out=out / "results", seeds=[0]
    )
    for row in report.rows:
        print(f"{row.method:<10} object AUROC {row.o_auroc:.3f}, point AUROC {row.p_auroc:.3f}")
    print(f"Results: {report.markdown_path}")


if __name__ == "__main__":
    main()
