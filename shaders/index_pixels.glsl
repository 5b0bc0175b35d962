// The source pixels of a tile; the tables of those are PIXELS wide.

layout(std430, binding = 3) buffer Heads { uint heads[]; };  // see index_load.comp, index_place.comp

// The pixel that a Gaussian of a tile that suits lies in.
uint pixel(Gaussian g)
{
    uvec2 at = uvec2(g.mean - origin());
    return at.y * PIXELS + at.x;
}
