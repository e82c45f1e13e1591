"""Interactive viewer: a field's parameters, the shader that renders them, and the controls, in one HTML page."""
