// Each row of a block starts with exponentials of its own; only along it one multiplies.
#define LINE(row) if (row < BLOCK) add_row(row, whiten, peak, d, fall);

void add_row(int row, vec3 whiten, vec3 peak, vec2 d, float fall)
{
    float right = whiten.x * pixel_size.x, y = d.y + float(row - MIDDLE) * pixel_size.y;
    float u = whiten.x * d.x + whiten.y * y, v = whiten.z * y;
    float along = exp2(-right * (right + 2.0 * u)), back = exp2(-right * (right - 2.0 * u));
    vec3 middle = peak * exp2(-(u * u + v * v)), color = middle;
    RIGHT(0) RIGHT(1) RIGHT(2) RIGHT(3) RIGHT(4)
    color = middle;
    LEFT(1) LEFT(2) LEFT(3) LEFT(4) LEFT(5)
}

void add(vec3 whiten, vec3 peak, vec2 d)
{
    float fall = exp2(-2.0 * whiten.x * whiten.x * pixel_size.x * pixel_size.x);
    LINE(0) LINE(1) LINE(2) LINE(3) LINE(4) LINE(5) LINE(6) LINE(7) LINE(8) LINE(9)
}
