"""The robot with mass, wheels and friction: its base in the PhysX engine, on the CPU, without a renderer."""
