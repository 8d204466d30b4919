"""What confines a jail: the plan (pure), its stages and mechanisms, the report, and the probe."""
