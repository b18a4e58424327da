// Aligns the world of a Unity app (AR Foundation) with a floor plan, from photographs of one spot.
//
// This sample was not run in Unity. `Align` is plain C#, which the tests compile with Mono and compare with
// lalaloc_client.alignment; the part for Unity, at the end, was not compiled. Send each photograph to POST /localise, or
// those of a turn to POST /localise/sequence, and keep the camera's Transform of the moment it was taken.

using System;
using System.Collections.Generic;

public struct LalalocPose
{
    public double X, Y, HeadingDeg;  // position.x_m, position.y_m and heading_deg of the answer
}

public struct LalalocCamera
{
    public double X, Y, Z;                       // transform.position
    public double ForwardX, ForwardY, ForwardZ;  // transform.forward
}

public struct LalalocAlignment
{
    public double YawDeg;   // turn about Unity's y axis, clockwise seen from above
    public double X, Y, Z;  // shift
    public double MisfitDeg, MisfitM;

    // A point of the plan (z over the floor) in the app's world.
    public void Point(double x, double y, double z, out double worldX, out double worldY, out double worldZ)
    {
        double angle = YawDeg * Math.PI / 180, sine = Math.Sin(angle), cosine = Math.Cos(angle);
        worldX = cosine * x + sine * y + X;
        worldY = z + Y;
        worldZ = -sine * x + cosine * y + Z;
    }

    public static LalalocAlignment Align(IList<LalalocPose> poses, IList<LalalocCamera> cameras, double cameraHeightM)
    {
        if (poses.Count == 0 || poses.Count != cameras.Count)
            throw new ArgumentException("give one camera for each pose");
        double sine = 0, cosine = 0;
        var turns = new double[poses.Count];
        for (int i = 0; i < poses.Count; i++)
        {
            LalalocCamera c = cameras[i];
            if (Math.Sqrt(c.ForwardX * c.ForwardX + c.ForwardZ * c.ForwardZ) < 0.5)
                throw new ArgumentException("the camera looks up or down, so that it has no heading; hold it upright");
            // Unity's azimuth and the plan's heading both grow clockwise.
            turns[i] = Math.Atan2(c.ForwardX, c.ForwardZ) - poses[i].HeadingDeg * Math.PI / 180;
            sine += Math.Sin(turns[i]);
            cosine += Math.Cos(turns[i]);
        }
        double turn = Math.Atan2(sine, cosine);
        var found = new LalalocAlignment { YawDeg = turn * 180 / Math.PI };
        var xs = new double[poses.Count];
        var zs = new double[poses.Count];
        for (int i = 0; i < poses.Count; i++)
        {
            double x, y, z;
            new LalalocAlignment { YawDeg = found.YawDeg }.Point(poses[i].X, poses[i].Y, cameraHeightM, out x, out y, out z);
            xs[i] = cameras[i].X - x;
            zs[i] = cameras[i].Z - z;
            found.X += xs[i] / poses.Count;
            found.Y += (cameras[i].Y - y) / poses.Count;
            found.Z += zs[i] / poses.Count;
        }
        for (int i = 0; i < poses.Count; i++)
        {
            found.MisfitDeg = Math.Max(found.MisfitDeg, Math.Abs(Math.IEEERemainder(turns[i] - turn, 2 * Math.PI)) * 180 / Math.PI);
            found.MisfitM = Math.Max(found.MisfitM, Math.Sqrt(Math.Pow(xs[i] - found.X, 2) + Math.Pow(zs[i] - found.Z, 2)));
        }
        if (found.MisfitDeg > 20 || found.MisfitM > 1)
            throw new ArgumentException("the photographs do not fit: give poses and cameras of the same photographs, in the same order");
        return found;
    }
}

#if UNITY_5_3_OR_NEWER
// Not compiled here. Parent what stands in the plan to `plan`, with x, height and y of the plan as its x, y and z.
public class LalalocAnchor : UnityEngine.MonoBehaviour
{
    public UnityEngine.Transform plan;

    public void Place(LalalocAlignment found)
    {
        plan.SetPositionAndRotation(
            new UnityEngine.Vector3((float)found.X, (float)found.Y, (float)found.Z),
            UnityEngine.Quaternion.Euler(0, (float)found.YawDeg, 0));
    }
}
#endif
