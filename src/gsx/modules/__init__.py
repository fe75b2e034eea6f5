"""Training modules: corrections of photos, schedules and stopping rules, on the hooks of a training step."""
