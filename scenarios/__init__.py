"""Scenarios: one `Scenario` type from four kinds of source."""
