#version 430 core
// The box round the ellipse of one Gaussian, as a strip of two triangles.

in vec2 mean;       // source pixels
in vec3 whitening;  // a, b, c of gaussian.glsl
in vec3 peak;       // red, green, blue
in vec2 reach;      // half the box, source pixels
uniform ivec2 base;     // the view's origin is base + fraction, source pixels
uniform vec2 fraction;
uniform vec2 scale;     // output pixels per source pixel
uniform vec2 size;      // of the output, pixels
out vec2 offset;        // from the mean, source pixels
flat out vec3 whiten;
flat out vec3 color;

void main()
{
    offset = (vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0) * reach;
    whiten = whitening;
    color = peak;
    vec2 at = (((mean - vec2(base)) - fraction) + offset) * scale;
    gl_Position = vec4(at / size * 2.0 - 1.0, 0.0, 1.0);
}
