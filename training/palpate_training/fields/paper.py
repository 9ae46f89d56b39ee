"""What the paper measured on real BioTacs, to stand beside results on the twin.

Narang et al., unseen trajectories: contact location and force of the best network for each (MLP;
voxel network for the magnitude, MLP for the angle), field and electrodes of PointNet++. The field
is counted on 128 ventral nodes, the electrodes over full scale and in counts.
"""

from __future__ import annotations

from collections.abc import Mapping

ALL_UNITS = "all units"

PAPER: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "field": {
        "biotac-1": {"nodal_subset_m": 0.21e-3},
        "biotac-2": {"nodal_subset_m": 0.20e-3},
        "biotac-3": {"nodal_subset_m": 0.25e-3},
        ALL_UNITS: {"nodal_subset_m": 0.22e-3},
    },
    "synthesis": {
        "biotac-1": {
            "electrode_rmse": 0.019,
            "electrode_rmse_counts": 80,
            "electrode_l2_median_counts": 225,
        },
        "biotac-2": {
            "electrode_rmse": 0.017,
            "electrode_rmse_counts": 73,
            "electrode_l2_median_counts": 166,
        },
        "biotac-3": {
            "electrode_rmse": 0.016,
            "electrode_rmse_counts": 66,
            "electrode_l2_median_counts": 187,
        },
    },
    "force": {
        "biotac-1": {"force_magnitude_median_n": 0.96, "force_angle_median_rad": 0.14},
        "biotac-2": {"force_magnitude_median_n": 0.78, "force_angle_median_rad": 0.15},
        "biotac-3": {"force_magnitude_median_n": 0.73, "force_angle_median_rad": 0.12},
        ALL_UNITS: {"force_magnitude_median_n": 0.64, "force_angle_median_rad": 0.15},
    },
    "location": {
        "biotac-1": {"location_distance_median_m": 1.5e-3, "location_distance_mean_m": 1.8e-3},
        "biotac-2": {"location_distance_median_m": 2.0e-3, "location_distance_mean_m": 2.1e-3},
        "biotac-3": {"location_distance_median_m": 2.4e-3, "location_distance_mean_m": 2.6e-3},
        ALL_UNITS: {"location_distance_median_m": 2.0e-3, "location_distance_mean_m": 2.2e-3},
    },
}
"""Task -> unit -> metric of ``palpate_training.evaluate.Result``, SI and counts."""
