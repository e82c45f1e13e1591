"""Write rendered frames to files: settings, files of one frame, all frames, videos."""
