"""Which components a scene needs: short trainings against each other, and how they are judged."""
