"""The prediction as TensorFlow functions of transmitter and walls."""
