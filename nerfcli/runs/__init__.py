"""What a trained run is: its settings, cameras, log, decisions and field, read from its folder in one place."""
