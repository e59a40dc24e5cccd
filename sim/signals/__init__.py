"""What goes into robots and comes out: commands, observations, rollouts."""
