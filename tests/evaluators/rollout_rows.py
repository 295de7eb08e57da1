"""Rows and manifests of rollouts with chosen values."""

from tests.run_records import manifest


def rows_of(values, metric="route_distance_m", renderer="3dgs", status="ok"):
    """Rows from a table of values: one row of it per scene, one column per seed; None is
    invalid.
    """
    return [
        {
            "renderer": renderer,
            "policy": "p",
            "scene": f"scene-{i}",
            "seed": k,
            "status": status,
            metric: value,
            f"{metric}_valid": value is not None,
        }
        for i, scene in enumerate(values)
        for k, value in enumerate(scene)
    ]


def manifests_of(values, metric="route_distance_m", **members):
    """Manifests of the rollouts of `rows_of`."""
    return [
        manifest(
            {key: row[key] for key in ("renderer", "policy", "scene", "seed", "status")}
            | {
                "metrics": {
                    metric: {
                        "value": row[metric],
                        "valid": row[f"{metric}_valid"],
                        "reason": "" if row[f"{metric}_valid"] else "not given",
                    }
                }
            }
            | members
        )
        for row in rows_of(values, metric)
    ]
