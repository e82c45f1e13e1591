"""How many metres a scene unit is: from known distances, GPS, or printed markers, each with its uncertainty."""
