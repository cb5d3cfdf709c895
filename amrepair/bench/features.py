"""Point features and memory banks of the baselines: raw coordinates, FPFH, coresets, search.

References
----------
Rusu et al., Fast Point Feature Histograms (FPFH) for 3D registration, ICRA 2009.
Roth et al., Towards Total Recall in Industrial Anomaly Detection (PatchCore), CVPR 2022.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Points, Values
from amrepair.bench.coreset_kernels import farthest_first
from amrepair.device import open3d

# The reference code's radii: normals 2v (30 neighbours), features 5v (100 neighbours).
NORMAL_RADIUS_VOXELS, NORMAL_NEIGHBOURS = 2.0, 30
FEATURE_RADIUS_VOXELS, FEATURE_NEIGHBOURS = 5.0, 100
# Brute force by matrix products beats trees in 33 dimensions; 256 rows at a time stay in cache.
QUERY_ROWS = 256
TREE_DIMENSIONS = 4
FILL_NEIGHBOURS = 3


def fpfh(points_mm: Points, voxel_mm: float) -> Float[np.ndarray, "n 33"]:
    """(n, 33) FPFH at every point, as Open3D computes it; normals are not oriented."""
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_mm))
    search = o3d.geometry.KDTreeSearchParamHybrid
    cloud.estimate_normals(search(NORMAL_RADIUS_VOXELS * voxel_mm, NORMAL_NEIGHBOURS))
    found = o3d.pipelines.registration.compute_fpfh_feature(
        cloud, search(FEATURE_RADIUS_VOXELS * voxel_mm, FEATURE_NEIGHBOURS)
    )
    return np.asarray(found.data).T.astype(np.float32)


def coreset(
    features: Float[np.ndarray, "n d"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, " k"]:
    """(k,) rows that cover the others best: greedy k-centre from a random start."""
    if count >= len(features):
        return np.arange(len(features))
    start = int(rng.integers(len(features)))
    rows = np.ascontiguousarray(features, dtype=np.float32)
    return np.asarray(farthest_first(rows, count, start))


def nearest(
    queries: Float[np.ndarray, "n d"], bank: Float[np.ndarray, "m d"]
) -> tuple[Values, Numbers]:
    """(n,) distance to the nearest row of the bank, and which row."""
    if bank.shape[1] <= TREE_DIMENSIONS:
        distance, index = cKDTree(bank).query(queries)
        return distance, index.astype(np.int64)
    bank = bank.astype(np.float32)
    bank_squared = (bank**2).sum(axis=1)
    index = np.empty(len(queries), np.int64)
    for start in range(0, len(queries), QUERY_ROWS):
        part = queries[start : start + QUERY_ROWS].astype(np.float32)
        index[start : start + QUERY_ROWS] = np.argmin(bank_squared - 2 * part @ bank.T, axis=1)
    # The expanded square loses digits by cancellation, so the distance is computed directly.
    gap = queries.astype(np.float64) - bank[index]
    return np.linalg.norm(gap, axis=1), index


def fill_in(
    points_mm: Points, chosen: Int[np.ndarray, " k"], values: Float[np.ndarray, " k"]
) -> Values:
    """(n,) values at all points from those at `chosen`: inverse distance, three neighbours."""
    if len(chosen) == len(points_mm):
        full = np.empty(len(points_mm))
        full[chosen] = values
        return full
    count = min(FILL_NEIGHBOURS, len(chosen))
    distance, index = cKDTree(points_mm[chosen]).query(points_mm, k=[*range(1, count + 1)])
    weight = 1.0 / np.maximum(distance, 1e-9 * np.ptp(points_mm, axis=0).max())
    return np.asarray((weight * values[index]).sum(axis=1) / weight.sum(axis=1))
