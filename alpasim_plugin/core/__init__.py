"""What every room may use: types, errors, geometry, time, random streams, image metrics."""
