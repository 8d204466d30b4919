"""The confinement of a jail: the plan (pure), its stages and mechanisms, the report, the probe."""
