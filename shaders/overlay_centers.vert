#version 430 core
// A square round the mean of each marked Gaussian, for a dot.

in vec4 place;
in vec4 look;
uniform vec2 size;   // of the output, pixels
uniform float reach;  // half the side of the square, pixels
out vec2 offset;      // from the mean, pixels
flat out vec3 peak;

void main()
{
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    offset = corner * reach;
    peak = look.yzw;
    gl_Position = vec4((place.xy + offset) / size * 2.0 - 1.0, 0.0, 1.0);
}
