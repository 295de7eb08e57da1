"""Rows of rollouts with chosen values."""


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
