"""Speed against error on the user's scene and machine: which settings are worth their time, and which are not."""
