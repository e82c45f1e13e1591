"""The field itself in one HTML file: its numbers, the shader that renders them, and what a visitor does with them."""
