"""Back from predictions to what they depend on: materials and places."""
