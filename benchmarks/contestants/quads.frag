#version 430 core
// What a Gaussian adds to a pixel; blending adds it up.

#include "gaussian.glsl"

in vec2 offset;
flat in vec3 whiten;
flat in vec3 color;
out vec4 added;

void main()
{
    added = vec4(color * gaussian_weight(whiten.x, whiten.y, whiten.z, offset.x, offset.y), 0.0);
}
