"""A trained run: settings, cameras, log, decisions and field, read from its folder in one place."""
