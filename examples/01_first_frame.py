"""Render one frame of a shipped scene and print what it holds."""

import thermorender as tr

scene = tr.load_scene("village")
print(scene)

renderer = tr.Renderer(scene, quality="fast")
frame = renderer.frame(scene.pose(0, -60, 60, pitch_deg=-45))

temperature = frame.apparent_temperature
print(f"apparent temperature {temperature.min():.1f} … {temperature.max():.1f} K, mean {temperature.mean():.1f} K")
print(f"a car at pixel {frame.targets['car_1_roof']['pixel']}, {frame.targets['car_1_roof']['range_m']} m away")
print(f"error budget {frame.budget_mk['total']:.0f} mK")
