"""What stands in an environment, without any rule: configuration, compiled scene, world views."""
