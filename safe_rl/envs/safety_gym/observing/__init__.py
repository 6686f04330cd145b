"""What a robot observes: its sensors, lidars, readings and camera, as one vector."""
