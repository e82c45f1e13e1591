"""What the HTML pages of all commands have in common: one file, no network, light and dark, and nothing unescaped."""
