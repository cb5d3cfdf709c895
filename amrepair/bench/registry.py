"""Methods by name, and what was published of them.

Published figures: PASDF (arXiv 2505.24431), tables 1 to 3, in per cent, on the published data.
"""

from __future__ import annotations

from pathlib import Path

from amrepair.bench.baselines import (
    BankMethod,
    Extractor,
    aligned_raw_features,
    fpfh_features,
    raw_features,
)
from amrepair.bench.method import Method
from amrepair.bench.samples import Format
from amrepair.errors import InputError
from amrepair.template.paper import PaperOptions

PAM = "+pam"
PAPER_METHOD = "pasdf-paper"
OWN_METHODS = ("pasdf", PAPER_METHOD)
BASELINES = ("btf-raw", "btf-fpfh", "patchcore-fpfh", "patchcore-fpfh-raw")
PRETRAINED = ("patchcore-pointmae", "patchcore-pointbert")  # with a checkpoint of the user's
BENCH_METHODS = (
    *OWN_METHODS,
    *(name + pam for name in (*BASELINES, *PRETRAINED) for pam in ("", PAM)),
)

# O-AUROC and P-AUROC, %; None where the paper prints none.
PUBLISHED: dict[str, dict[str, tuple[float | None, float | None]]] = {
    Format.SHAPENET: {
        "pasdf-paper": (90.0, 89.7),
        "btf-raw": (49.3, 55.0),
        "btf-fpfh": (52.8, 62.8),
        "btf-fpfh+pam": (57.9, 68.3),
        "patchcore-fpfh": (56.8, 58.0),
        "patchcore-fpfh+pam": (81.4, 86.7),
        "patchcore-pointmae": (56.2, 57.7),
        "patchcore-pointmae+pam": (62.6, 68.1),
        "M3DM": (55.2, 61.6),
        "CPMF": (55.9, 57.3),
        "Reg3D-AD": (57.2, 66.8),
        "IMRNet": (66.1, 65.0),
        "R3D-AD": (74.9, None),
        "SeDiR": (93.3, 81.0),
        "DLF-3AD": (92.1, 92.4),
        "AF3AD": (91.5, 92.5),
        "Simple3D": (86.0, 92.9),
        "Template3D-AD": (86.5, None),
    },
    Format.REAL3D: {
        "pasdf-paper": (80.2, 74.5),
        "btf-raw": (63.5, 57.1),
        "btf-fpfh": (60.3, 73.3),
        "patchcore-fpfh": (59.3, 57.7),
        "patchcore-fpfh-raw": (68.2, 68.0),
        "patchcore-pointmae": (59.4, 64.2),
        "M3DM": (55.2, 63.7),
        "Reg3D-AD": (70.4, 70.5),
        "IMRNet": (72.5, None),
        "R3D-AD": (None, 63.5),
        "Group3AD": (75.1, 73.5),
        "SeDiR": (81.0, 80.6),
        "DLF-3AD": (85.9, 85.2),
        "AF3AD": (85.2, 86.1),
        "Simple3D": (80.4, 92.3),
        "Template3D-AD": (84.4, 92.5),
    },
}
# CD and EMD of the repair template, with positional encoding.
PUBLISHED_REPAIR: dict[str, tuple[float, float]] = {
    Format.REAL3D: (0.0203, 0.0110),
    Format.SHAPENET: (0.0445, 0.0228),
}


def make_method(
    name: str, *, checkpoint: Path | None = None, paper: PaperOptions | None = None
) -> Method:
    """Return the method that has this name on the command line.

    Parameters
    ----------
    checkpoint
        Weights, for the methods that need them.
    paper
        Recipe of `pasdf-paper`; None takes the benchmark's shortened one.

    Raises
    ------
    InputError
        If the name is unknown, or the weights it needs are not given or not right.
    """
    if name not in BENCH_METHODS:
        raise InputError(f"the method '{name}' is unknown; choose from {', '.join(BENCH_METHODS)}")
    base, pam = name.removesuffix(PAM), name.endswith(PAM)
    if name == "pasdf":
        from amrepair.bench.house import FieldMethod

        return FieldMethod()
    from amrepair.bench.paper import BENCH_PAPER, PaperMethod, make_pam_aligner

    if name == PAPER_METHOD:
        return PaperMethod(paper or BENCH_PAPER)
    features = _extractors(base, pam=pam, checkpoint=checkpoint)
    return BankMethod(features, base.startswith("patchcore"), make_pam_aligner if pam else None)


def _extractors(base: str, *, pam: bool, checkpoint: Path | None) -> tuple[Extractor, ...]:
    if base in PRETRAINED:
        from amrepair.bench.pointmae import load_checkpoint

        return (load_checkpoint(checkpoint, base.removeprefix("patchcore-")).extract,)
    raw: Extractor = aligned_raw_features if pam else raw_features
    named: dict[str, tuple[Extractor, ...]] = {
        "btf-raw": (raw,),
        "btf-fpfh": (fpfh_features,),
        "patchcore-fpfh": (fpfh_features,),
        "patchcore-fpfh-raw": (fpfh_features, raw),
    }
    return named[base]
