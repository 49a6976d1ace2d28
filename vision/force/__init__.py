"""A testing machine's recording becomes stick-slip events."""
