"""Common parts of the HTML pages of all commands: one file, no network, light and dark, everything escaped."""
