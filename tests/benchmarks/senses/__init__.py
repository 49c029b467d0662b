"""What a robot does when its depth camera, its camera or its wheels lie."""
