#version 430 core
// A light core with a dark rim, so that it reads on any picture.

in vec2 offset;      // from the mark's middle, pixels
flat in vec3 peak;   // opacity * color of the Gaussian
uniform float core;  // half the width of the core, pixels
uniform float rim;   // of the rim, from where the core ends, pixels
uniform vec4 fixed_color;  // alpha 0: the Gaussian's own
uniform float fade;  // [0, 1]
out vec4 premultiplied;

void main()
{
    float brightest = max(peak.r, max(peak.g, peak.b));
    vec3 own = mix(peak / max(brightest, 1e-6), vec3(1.0), 0.2);
    vec3 color = mix(own, fixed_color.rgb, fixed_color.a);
    float strength = fade * min(1.0, 1.3 * sqrt(brightest));  // what adds little is drawn faint
    float distance = length(offset);
    float inside = clamp(core + 0.5 - distance, 0.0, 1.0);  // over one pixel: antialiased
    float around = 0.55 * clamp((core + rim - distance) / rim, 0.0, 1.0);
    float alpha = inside + (1.0 - inside) * around;
    premultiplied = vec4(color * inside, alpha) * strength;
}
