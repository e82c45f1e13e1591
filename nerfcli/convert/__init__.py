"""From one format of captures to another: which is which, what gets lost, and the proof that nothing else did."""
