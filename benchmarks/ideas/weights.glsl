// The weight is followed from pixel to pixel, and multiplied by the colour at each.
#define RIGHT_BY_WEIGHT(k) if (MIDDLE + k < BLOCK) { \
    sum[SLOTS * row + MIDDLE + k] += peak * w; w *= along; along *= fall; }
#define LEFT_BY_WEIGHT(k) if (MIDDLE - k >= 0) { \
    w *= back; back *= fall; sum[SLOTS * row + MIDDLE - k] += peak * w; }

void add_row(int row, vec3 peak, float weight, float along, float back, float fall)
{
    float w = weight;
    RIGHT_BY_WEIGHT(0) RIGHT_BY_WEIGHT(1) RIGHT_BY_WEIGHT(2) RIGHT_BY_WEIGHT(3) RIGHT_BY_WEIGHT(4)
    w = weight;
    LEFT_BY_WEIGHT(1) LEFT_BY_WEIGHT(2) LEFT_BY_WEIGHT(3) LEFT_BY_WEIGHT(4) LEFT_BY_WEIGHT(5)
}

#define BELOW_BY_WEIGHT(k) if (MIDDLE + k < BLOCK) { \
    add_row(MIDDLE + k, peak, w, a, b, fall); w *= below; below *= sink; a *= twist; b *= untwist; }
#define ABOVE_BY_WEIGHT(k) if (MIDDLE - k >= 0) { \
    w *= above; above *= sink; a *= untwist; b *= twist; add_row(MIDDLE - k, peak, w, a, b, fall); }

void add(vec3 whiten, vec3 peak, vec2 d)
{
    float right = whiten.x * pixel_size.x;
    vec2 down = whiten.yz * pixel_size.y;
    vec2 uv = vec2(whiten.x * d.x + whiten.y * d.y, whiten.z * d.y);
    float middle = exp2(-dot(uv, uv));
    float along = exp2(-right * (right + 2.0 * uv.x)), back = exp2(-right * (right - 2.0 * uv.x));
    float below = exp2(-dot(down, down + 2.0 * uv)), above = exp2(-dot(down, down - 2.0 * uv));
    float fall = exp2(-2.0 * right * right), sink = exp2(-2.0 * dot(down, down));
    float twist = exp2(-2.0 * right * down.x), untwist = exp2(2.0 * right * down.x);
    float w = middle, a = along, b = back;
    BELOW_BY_WEIGHT(0) BELOW_BY_WEIGHT(1) BELOW_BY_WEIGHT(2) BELOW_BY_WEIGHT(3) BELOW_BY_WEIGHT(4)
    w = middle, a = along, b = back;
    ABOVE_BY_WEIGHT(1) ABOVE_BY_WEIGHT(2) ABOVE_BY_WEIGHT(3) ABOVE_BY_WEIGHT(4) ABOVE_BY_WEIGHT(5)
}
