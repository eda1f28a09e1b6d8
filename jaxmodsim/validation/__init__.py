"""Above everything: hard cases with their answers, and the behaviour bench of the friction laws."""
