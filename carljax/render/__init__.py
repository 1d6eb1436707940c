"""Pictures for people: never imported by the simulator or the learner."""
