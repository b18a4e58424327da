import{a,b}from"./chunk-UZLLWKBJ.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
