using System;
using System.Collections.Generic;
using System.IO;
using UnityEditor;
using UnityEditor.AssetImporters;

namespace Beam.Relightable.Editor {
    /// <summary>Imports containers (b4d): facts and a box; the file itself is streamed when it plays.</summary>
    [ScriptedImporter(1, "b4d")]
    public sealed class TakeImporter : ScriptedImporter {
        public override void OnImportAsset(AssetImportContext context) {
            try {
                var take = new Container(context.assetPath);
                Dictionary<string, float[]> first = take.Frame(take.Read(take.Segments[0]), 0);
                TakeAsset asset = Imported.Asset(first, take.Count);
                asset.sourcePath = context.assetPath;
                asset.guid = AssetDatabase.AssetPathToGUID(context.assetPath);
                asset.frames = take.Frames;
                asset.rate = (float)take.Rate;
                asset.isConstant = take.IsConstant;
                Imported.SetFilter(asset, take.Metadata);
                if (!first.ContainsKey("base_color")) context.LogImportWarning("The take has no materials: it is drawn grey.");
                context.AddObjectToAsset("take", asset);
                context.SetMainObject(asset);
            } catch (Exception error) when (error is DeliveryException || error is IOException) {
                context.LogImportError(error.Message);
            }
        }
    }
}
