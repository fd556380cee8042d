"""Cross-validation of the estimators with Mitsuba's path tracer."""
