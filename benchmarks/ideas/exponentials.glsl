// An exponential per pixel.
#define EVALUATE(j, i) if (j < BLOCK && i < BLOCK) { \
    vec2 at = d + vec2(i - MIDDLE, j - MIDDLE) * pixel_size; \
    sum[SLOTS * j + i] += peak * gaussian_weight(whiten.x, whiten.y, whiten.z, at.x, at.y); }

void add(vec3 whiten, vec3 peak, vec2 d)
{
    ALL(EVALUATE)
}
