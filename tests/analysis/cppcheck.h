/* Loops of jansson that cppcheck does not find by itself, as it should see them; for nothing but cppcheck. */
#define json_array_foreach(list, k, value) for ((k) = 0; ((value) = json_array_get((list), (k))); (k)++)
#define json_object_foreach(object, name, value) while (((name) = json_object_name((object), &(value))))
