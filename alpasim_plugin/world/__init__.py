"""The world a scene lives in: lanes, ground, route, roads and actors."""
